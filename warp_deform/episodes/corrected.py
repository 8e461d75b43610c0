"""Corrected episodes: a policy acted, and a teacher said in every state what it would have done.

Such a file is an episode like any other: its actions are those that were carried out, so it replays
bit by bit. What the teacher would have done stands beside them, under `CORRECTION` of the metadata.
Training learns the labels, not the actions.

Source: Ross et al., AISTATS 2011 (DAgger).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from . import EpisodeInfo

__all__ = ["CORRECTION", "correction", "corrector", "is_corrected", "labels_of", "refuse_corrected"]

CORRECTION = "correction"
"""Key of `EpisodeInfo.extra`: who taught, whose policy acted, and a label for every action."""
_BY = "corrected by "
_NUMBERS = 7


def corrector(teacher: str) -> str:
    """What a corrected episode names as its demonstrator.

    Examples:
        >>> corrector("mpc")
        'corrected by mpc'
    """
    return _BY + teacher


def is_corrected(demonstrator: str) -> bool:
    """Whether an episode of this demonstrator is a corrected one.

    Examples:
        >>> is_corrected("corrected by mpc"), is_corrected("mpc")
        (True, False)
    """
    return demonstrator.startswith(_BY)


def correction(
    teacher: str, labels: Sequence[np.ndarray | None], *, policy: str
) -> dict[str, dict[str, Any]]:
    """What goes into `EpisodeInfo.extra`, as JSON types.

    Args:
        labels: what the teacher would have done in place of every action (7,) each; None where it
            had nothing to say that an agent can learn
        policy: digest of the weights that acted
    """
    numbers = [None if label is None else [float(x) for x in label] for label in labels]
    return {CORRECTION: {"teacher": teacher, "policy": policy, "labels": numbers}}


def labels_of(info: EpisodeInfo, *, what: object) -> list[np.ndarray | None]:
    """The teacher's label (7,) float64 for every action of a corrected episode, None without one.

    Args:
        what: names the episode in an error

    Raises:
        InputError: the metadata hold none, or not one for every action.
    """
    record = info.extra.get(CORRECTION)
    labels = record.get("labels") if isinstance(record, dict) else None
    if not isinstance(labels, list) or len(labels) != info.actions:
        raise InputError(
            f"{what} is {info.demonstrator} and holds no label for each of its {info.actions} "
            "actions; correct its seed again"
        )
    return [None if label is None else _label(label, what) for label in labels]


def refuse_corrected(infos: Iterable[EpisodeInfo], *, folder: Path, advice: str) -> None:
    """Raise InputError if there is a corrected episode among these, with what to do instead."""
    for info in infos:
        if is_corrected(info.demonstrator):
            raise InputError(
                f"{folder} holds corrected episodes (seed {info.seed}), in which a policy acted; "
                + advice
            )


def _label(label: Any, what: object) -> np.ndarray:
    numbers = isinstance(label, list) and all(type(x) in (int, float) for x in label)
    if numbers and len(label) == _NUMBERS:
        array = np.array(label, dtype=np.float64)
        if np.isfinite(array).all():
            return array
    raise InputError(f"{what} holds a label that is no action of {_NUMBERS} finite numbers")
