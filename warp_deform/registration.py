"""The tasks' Gymnasium ids."""

from __future__ import annotations

from .tasks.registry import FURTHER_TASKS, TASKS

__all__ = ["env_id", "register_environments"]

_VERSION = 1  # rises with any change of physics, observation or reward


def env_id(task: str) -> str:
    """Gymnasium id of the task called `task`: `cable-ring` is `WarpDeform/CableRing-v1`."""
    words = "".join(word.capitalize() for word in task.split("-"))
    return f"WarpDeform/{words}-v{_VERSION}"


def register_environments() -> None:
    """Register one Gymnasium id a task; a second call changes nothing.

    The environment's module loads when `gymnasium.make` builds the first one.
    """
    from gymnasium.envs.registration import register, registry

    for task in TASKS | FURTHER_TASKS:
        if env_id(task) not in registry:
            register(
                env_id(task),
                entry_point="warp_deform.env:PickPlaceEnv",
                vector_entry_point="warp_deform.vector_env:PickPlaceVectorEnv",
                kwargs={"task": task},
            )
