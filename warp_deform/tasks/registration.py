"""The tasks' Gymnasium ids, and how a task of the user's own gets one."""

from __future__ import annotations

from typing import TypeVar

from ..errors import InputError
from .checking import check_task
from .external import offered, offered_version
from .registry import FURTHER_TASKS, TASKS, add_task, registered
from .task import Task

__all__ = ["control_id", "env_id", "register_environments", "register_task"]

CONTROL_VERSION = 1
"""Of the ids of control: rises with any change of its physics, observation or reward."""
CONTROL_ALONE = (
    "whip", "whip-target", "push-cable", "fold-fabric-1", "fold-fabric-3", "unfold-fabric-1",
    "unfold-fabric-3", "gather", "wire", "unknot",
)  # fmt: skip
"""Tasks that are only for control; they stand in `warp_deform.control.registry`."""

Registered = TypeVar("Registered", bound="type[Task]")


def env_id(task: str) -> str:
    """Gymnasium id of the task called `task`: `cable-ring` is `WarpDeform/CableRing-v3`.

    Of an installed task that has not been loaded, the version is what its entry point says.
    """
    known = TASKS | FURTHER_TASKS | {cls.name: cls for cls in registered()}
    version = known[task].version if task in known else offered_version(task)
    return f"WarpDeform/{_words(task)}-v{version}"


def _words(task: str) -> str:
    return "".join(word.capitalize() for word in task.split("-"))


def register_environments() -> None:
    """Register one Gymnasium id a task; a second call changes nothing.

    Tasks of installed distributions get theirs by their names alone. The environment's module, and
    theirs, load when `gymnasium.make` builds the first one.
    """
    for task in (*TASKS, *FURTHER_TASKS, *offered()):
        _register(task)
    for task in CONTROL_ALONE:
        _register_control(control_id(task), task)


def register_task(task: Registered) -> Registered:
    """Make a task of one's own known by its name: to `gymnasium.make`, and to all that takes names.

        @warp_deform.register_task
        class CableAway(Task):
            name = "cable-away"
            ...

    Returns the class. Worker processes of collections, replays, evaluations and sweeps are told of
    it. The same class again changes nothing.

    Raises:
        InputError: the class lacks something or has an attribute of a wrong type, or its name or
            Gymnasium id is another task's.
    """
    check_task(task)
    for other in (*TASKS, *FURTHER_TASKS, *(cls.name for cls in registered())):
        if other != task.name and _words(other) == _words(task.name):
            raise InputError(
                f"the Gymnasium id of {task.name!r} would be that of {other!r}; rename it"
            )
    add_task(task)
    _register(task.name)
    return task


def control_id(task: str) -> str:
    """Gymnasium id of the control of `task`: of `cable-ring` `WarpDeform/CableRing-Control-v1`.

    Tasks that are only for control need no such word: `whip` is `WarpDeform/Whip-v1`.
    """
    words = _words(task) + ("" if task in CONTROL_ALONE else "-Control")
    return f"WarpDeform/{words}-v{CONTROL_VERSION}"


def _register(task: str) -> None:
    from gymnasium.envs.registration import register, registry

    known = TASKS | FURTHER_TASKS
    if task not in known or known[task].jaw is None:
        _register_control(control_id(task), task)
    same = f"WarpDeform/{_words(task)}-v"
    for other in [each for each in registry if each.startswith(same) and each != env_id(task)]:
        del registry[other]  # of the class whose place this one takes
    if env_id(task) not in registry:
        register(
            env_id(task),
            entry_point="warp_deform.envs.env:PickPlaceEnv",
            vector_entry_point="warp_deform.envs.vector_env:PickPlaceVectorEnv",
            kwargs={"task": task},
        )


def _register_control(name: str, task: str) -> None:
    from gymnasium.envs.registration import register, registry

    if name not in registry:
        register(
            name,
            entry_point="warp_deform.envs.control_env:ControlEnv",
            vector_entry_point="warp_deform.envs.control_vector_env:ControlVectorEnv",
            kwargs={"task": task},
        )
