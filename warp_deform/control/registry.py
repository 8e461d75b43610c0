"""The tasks that are made for control, by name; tasks of the benchmark are found beside them."""

from __future__ import annotations

from ..errors import InputError
from ..tasks.registry import task_of
from ..tasks.task import Task
from .control_task import ControlTask
from .fold_fabric import FoldFabric1
from .fold_fabric_3 import FoldFabric3
from .gather import Gather
from .push_cable import PushCable
from .unfold_fabric import UnfoldFabric1, UnfoldFabric3
from .unknot import Unknot
from .whip import Whip, WhipTarget
from .wire import Wire

__all__ = ["control_task"]  # `warp_deform.control` has `CONTROL_TASKS`

CONTROL_TASKS: dict[str, type[ControlTask]] = {
    cls.name: cls
    for cls in (
        Whip, WhipTarget, PushCable, FoldFabric1, FoldFabric3, UnfoldFabric1, UnfoldFabric3,
        Gather, Wire, Unknot,
    )
}  # fmt: skip
"""The tasks that are only for control, by their names; each has an id, see `warp-deform list`."""


def control_task(task: str | Task) -> Task:
    """A task that a tip can be led in, by its name or as it is.

    Raises:
        InputError: there is no such task, or it is played with a jaw.
    """
    if isinstance(task, str) and task in CONTROL_TASKS:
        return CONTROL_TASKS[task]()
    found = task_of(task)
    if found.jaw is not None:
        raise InputError(f"{found.name} is played with a jaw; control leads a suction tip")
    return found
