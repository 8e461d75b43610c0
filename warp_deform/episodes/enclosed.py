"""`ENCLOSED`: the key of an episode file that says whether the bag enclosed its items."""

from __future__ import annotations

from collections.abc import Iterable

from . import EpisodeInfo

__all__ = ["ENCLOSED", "enclosed_count"]

ENCLOSED = "enclosed"
"""Key of `EpisodeInfo.extra`, of tasks whose bag is to keep items, see `Task.enclosed`."""


def enclosed_count(infos: Iterable[EpisodeInfo]) -> int | None:
    """How many episodes' bags enclosed their items; None where no episode says."""
    said = [info.extra[ENCLOSED] for info in infos if ENCLOSED in info.extra]
    return sum(map(bool, said)) if said else None
