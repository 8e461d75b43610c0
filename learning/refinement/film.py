"""Refined trajectories beside what they were."""

from __future__ import annotations

from pathlib import Path

from warp_deform.collecting.control_video import film_control
from warp_deform.collecting.video import check_video
from warp_deform.episodes import EpisodeReader
from warp_deform.errors import InputError

from .refine import REFINEMENT

__all__ = ["check_filmed", "film_refined"]

FILMED = 2
"""Episodes in a video."""
_SIZE = (540, 720)


def check_filmed(source: Path, path: Path) -> None:
    """Raise InputError where no video of a folder's refinement could be written to `path`."""
    check_video(path)
    if any(info.control is None for info in EpisodeReader(source, control=True).infos()):
        raise InputError(
            f"{source} has picks and places, which no film shows at 20 Hz; leave out --video, or "
            "collect with `warp-deform demo --control`"
        )


def film_refined(source: Path, refined: Path, path: Path) -> None:
    """Write an MP4 of the first refined episodes, each beside its original.

    Improved ones come first.

    Raises:
        InputError: see `check_filmed`.
        WarpDeformError: the start of an episode comes out differently here.
    """
    infos = EpisodeReader(refined, control=True).infos()
    infos.sort(key=lambda info: not info.extra[REFINEMENT]["improved"])
    film_control(
        [source, refined],
        path,
        seeds=[info.seed for info in infos[:FILMED]],
        names=["recorded", "refined"],
        size=_SIZE,
    )
