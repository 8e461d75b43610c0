"""The tasks by name. A new task is one file and one line here; the tests run over this dict."""

from __future__ import annotations

import difflib

from ..errors import InputError
from .bag_alone_open import BagAloneOpen
from .bag_color_goal import BagColorGoal
from .bag_items import BagItems1, BagItems2
from .block import BlockNotarget
from .cable_line import CableLineNotarget
from .cable_mask_goal import CableMaskGoal
from .cable_ring import CableRing, CableRingNotarget
from .cable_shape import CableShape, CableShapeNotarget
from .fabric_cover import FabricCover
from .fabric_flat import FabricFlat, FabricFlatNotarget
from .task import Task

__all__ = ["FURTHER_TASKS", "TASKS", "task"]

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
"""Tasks that are not of the benchmark: of the paper's physical experiments."""


def task(name: str) -> Task:
    """The task called `name`.

    Raises:
        InputError: there is none; the message says which name is nearest.
    """
    known = TASKS | FURTHER_TASKS
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1, cutoff=0.0)[0]
        raise InputError(
            f"there is no task {name!r}; did you mean {near!r}? `warp-deform list` shows all"
        )
    return known[name]()
