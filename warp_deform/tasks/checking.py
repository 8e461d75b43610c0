"""Whether a class is a task: what is missing or of another type is said before anything runs."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from ..errors import InputError
from ..rendering.pixels import PixelGrid
from ..robots.primitive import LIFT, PrimitiveConfig, Stage
from ..xpbd.config import SolverConfig
from .ground_truth import row_count
from .task import Task

__all__ = ["check_task"]

_NAME = re.compile(r"(?!.*-v\d+$)[a-z][a-z0-9]*(-[a-z0-9]+)*")


@dataclass(frozen=True)
class _Attribute:
    """What a class attribute has to be: in words, and as a test."""

    words: str
    fits: Callable[[Any], bool]


def _whole(value: Any) -> bool:
    return type(value) is int and value >= 1


def _share(value: Any) -> bool:
    return type(value) in (int, float) and 0 < value <= 1


def _stages(value: Any) -> bool:
    return (
        isinstance(value, tuple)
        and len(value) > 0
        and all(isinstance(s, Stage) and LIFT[0] <= s.lift <= LIFT[1] for s in value)
    )


def _names(value: Any) -> bool:
    return isinstance(value, tuple) and all(isinstance(each, str) for each in value)


_ATTRIBUTES = {
    "stages": _Attribute(
        f"a tuple of one or more Stage, each lift {LIFT[0]} to {LIFT[1]} m", _stages
    ),
    "success_score": _Attribute("a number above 0 and at most 1", _share),
    "ground_truth_size": _Attribute(
        "a whole number, 1 or more (or give ground_truth_rows)", _whole
    ),
    "goal_conditioned": _Attribute("True or False", lambda value: type(value) is bool),
    "max_actions": _Attribute("a whole number, 1 or more", _whole),
    "objects": _Attribute("a tuple of names", _names),
    "version": _Attribute("a whole number, 1 or more", _whole),
    "solver": _Attribute("a SolverConfig", lambda value: isinstance(value, SolverConfig)),
    "primitive": _Attribute("a PrimitiveConfig", lambda value: isinstance(value, PrimitiveConfig)),
    "grid": _Attribute("a PixelGrid", lambda value: isinstance(value, PixelGrid)),
    "rotated_copies": _Attribute(
        "None or a whole number, 1 or more", lambda value: value is None or _whole(value)
    ),
    "mirrors": _Attribute("True or False", lambda value: type(value) is bool),
    "looks_aloft": _Attribute("True or False", lambda value: type(value) is bool),
    "place_yaws": _Attribute("a whole number, 1 or more", _whole),
}
_OF_GOALS = ("goal_layout", "goal_targets")


def check_task(task: object) -> type[Task]:
    """The class, once it is sure that it is a task's.

    Raises:
        InputError: it is no class of a task, it does not implement what every task has to, or one
            of its attributes is missing or of another type.
    """
    if isinstance(task, Task):
        raise InputError(f"a task is registered by its class, {type(task).__name__}, not an object")
    if not (isinstance(task, type) and issubclass(task, Task)):
        raise InputError(f"a task is a class derived from Task, not {repr(task)[:60]}")
    where = f"the task {task.__module__}.{task.__qualname__}"
    if missing := sorted(getattr(task, "__abstractmethods__", ())):
        raise InputError(f"{where} does not implement {', '.join(missing)}")
    name = getattr(task, "name", None)
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise InputError(
            f"{where}: name is {name!r}; it must be words of lower-case letters and digits, with "
            "hyphens between them and no version behind, as 'cable-away'"
        )
    for attribute, needed in _ATTRIBUTES.items():
        value = getattr(task, attribute, None)
        if not needed.fits(value):
            shown = repr(value)[:60] if hasattr(task, attribute) else "missing"
            raise InputError(f"{where}: {attribute} is {shown}; it must be {needed.words}")
    rows = row_count(task.ground_truth_rows)
    if rows and task.ground_truth_size != 3 * rows:
        raise InputError(
            f"{where}: ground_truth_size is {task.ground_truth_size}, and ground_truth_rows are "
            f"{rows} rows; there are three numbers a row, so leave ground_truth_size out"
        )
    if task.goal_conditioned:
        for method in _OF_GOALS:
            if getattr(task, method) is getattr(Task, method):
                raise InputError(f"{where} is goal-conditioned and does not implement {method}")
    try:
        task()
    except TypeError as error:
        raise InputError(f"{where} has to be made without arguments: {error}") from error
    return task
