"""The tasks by name: those of this package, and those that users register.

`TASKS` are the paper's, and all tests of tasks run over them. A new task of this package is one
file and one line in `FURTHER_TASKS`, with tests of its own. Others are registered by
`warp_deform.register_task`, or offered by installed distributions.
"""

from __future__ import annotations

import difflib

from ..errors import InputError, WarpDeformError
from .bag_alone_open import BagAloneOpen
from .bag_color_goal import BagColorGoal
from .bag_items import BagItems1, BagItems2
from .block import BlockNotarget
from .cable_line import CableLineNotarget
from .cable_mask_goal import CableMaskGoal
from .cable_ring import CableRing, CableRingNotarget
from .cable_shape import CableShape, CableShapeNotarget
from .checking import check_task
from .external import load_offered, offered
from .fabric_cover import FabricCover
from .fabric_flat import FabricFlat, FabricFlatNotarget
from .task import Task

__all__ = [
    "FURTHER_TASKS",
    "TASKS",
    "add_task",
    "all_tasks",
    "is_known",
    "registered",
    "task",
    "task_name",
    "task_of",
]

TASKS: dict[str, type[Task]] = {
    cls.name: cls
    for cls in (
        CableRing,
        CableRingNotarget,
        CableShape,
        CableShapeNotarget,
        CableLineNotarget,
        FabricCover,
        FabricFlat,
        FabricFlatNotarget,
        BagAloneOpen,
        BagItems1,
        BagItems2,
        BagColorGoal,
        BlockNotarget,
    )
}
"""Task classes by the paper's names, in the paper's order."""

FURTHER_TASKS: dict[str, type[Task]] = {cls.name: cls for cls in (CableMaskGoal,)}
"""Other tasks of this package: so far that of the paper's physical experiments."""


_OURS = TASKS | FURTHER_TASKS
_REGISTERED: dict[str, type[Task]] = {}


def add_task(task: type[Task]) -> type[Task]:
    """Add a class to those that are found by name; the same class again changes nothing.

    A class of the same module and name takes the place of the earlier one, as where a cell of a
    notebook runs again.

    Raises:
        InputError: it is no task, or another task has its name.
    """
    check_task(task)
    before = _OURS.get(task.name) or _REGISTERED.get(task.name)
    if before is not None and (task.name in _OURS or task_name(before) != task_name(task)):
        whose = "the package" if task.name in _OURS else task_name(before)
        raise InputError(
            f"{task_name(task)} cannot be called {task.name!r}: a task of {whose} is; rename it"
        )
    _REGISTERED[task.name] = task
    return task


def registered() -> tuple[type[Task], ...]:
    """The classes that were added in this process, which others do not know of."""
    return tuple(_REGISTERED.values())


def is_known(name: str) -> bool:
    """Whether there is a task of this name; nothing is imported."""
    return name in _OURS or name in _REGISTERED or name in offered()


def all_tasks() -> tuple[dict[str, type[Task]], list[str]]:
    """All tasks: the benchmark's, further ones, then others by name; and what is wrong with any.

    Imports what installed distributions offer. One that cannot be used is a line of the list.
    """
    further, wrong = dict(_REGISTERED), []
    for name, points in offered().items():
        if name in _OURS:
            whose = ", ".join(point.dist.name if point.dist else "unknown" for point in points)
            wrong.append(f"the distribution {whose} offers a task {name!r}, as the package does")
            continue
        try:
            further[name] = type(task(name))
        except WarpDeformError as error:
            wrong.append(str(error))
    return _OURS | dict(sorted(further.items())), wrong


def task(name: str, *, recorded: str | None = None) -> Task:
    """The task called `name`.

    Args:
        recorded: class of the task, `task_name`, where a recording says so; it is only told, since
            code is never imported because a file says so

    Raises:
        InputError: there is none; the message says which name is nearest, and where it was from.
    """
    if (cls := _OURS.get(name) or _REGISTERED.get(name)) is not None:
        return cls()
    if (cls := load_offered(name)) is not None:
        return add_task(cls)()
    if recorded is not None:
        raise InputError(
            f"there is no task {name!r} here; it was recorded of {recorded}: name that module or "
            "its file with --task-module, or call register_task with the class"
        )
    near = difflib.get_close_matches(str(name), [*_OURS, *_REGISTERED, *offered()], n=1, cutoff=0.0)
    raise InputError(
        f"there is no task {name!r}; did you mean {near[0]!r}? `warp-deform list` shows all; a "
        "task of your own has to be registered, by --task-module or register_task"
    )


def task_of(task_or_name: str | Task) -> Task:
    """A task by its name, or as it is.

    Raises:
        InputError: there is no such task, or this is none.
    """
    if isinstance(task_or_name, Task):
        return task_or_name
    if isinstance(task_or_name, str):
        return task(task_or_name)
    if isinstance(task_or_name, type) and issubclass(task_or_name, Task):
        return check_task(task_or_name)()
    raise InputError(f"a task is a name or a Task, not {repr(task_or_name)[:60]}")


def task_name(task: type[Task]) -> str:
    """Where a task's class stands: module and name, `my_tasks:CableAway`."""
    return f"{task.__module__}:{task.__qualname__}"
