"""Picks and places as control at a fixed rate: the same ones, led through the action space."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from warp_deform.collecting.control_episodes import (
    ControlSetup,
    control_worlds,
    play_control_episodes,
)
from warp_deform.collecting.recording import recorded_task
from warp_deform.control.tip_demonstrator import TipDemonstrator, usual_mode
from warp_deform.episodes import Episode, EpisodeInfo
from warp_deform.worlds.loop import SOLVED, EpisodeRun
from warp_deform.worlds.worlds import Worlds

__all__ = ["resampled", "setup_for"]

_PLACED = "placed"


def setup_for(info: EpisodeInfo, *, horizon: int | None) -> ControlSetup:
    """How tips are led that repeat a recorded episode of picks and places."""
    task = recorded_task(info)
    return ControlSetup(type(task), info.robot, usual_mode(task), horizon=horizon)


def resampled(episode: Episode, how: ControlSetup) -> tuple[np.ndarray | None, str]:
    """Actions (T, A) that make a recorded episode's picks and places, and how that ended.

    None stands for actions that do not solve the task: things may move otherwise at 20 Hz. Picks
    that took nothing are left out.
    """
    picks = [
        step.action for step in episode.steps if step.action is not None and step.outcome == _PLACED
    ]
    control = control_worlds(how)
    tips = TipDemonstrator(control, _Recorded(picks).act)
    runs = play_control_episodes(
        control,
        [episode.info.seed],
        start=lambda runs: tips.start(list(runs)),
        act=lambda runs: tips.act(list(runs)),
    )
    ((_, run),) = runs
    if not run.rows or run.rows[0].state_hash != episode.steps[0].state_hash:
        return None, "does not start as recorded"
    if run.ended != SOLVED:
        return None, run.ended or ""
    return np.array(run.actions), SOLVED


class _Recorded:
    """Says one recorded pick and place after the other."""

    def __init__(self, picks: Sequence[np.ndarray]) -> None:
        self._rest = list(picks)

    def act(
        self, worlds: Worlds, runs: Mapping[int, EpisodeRun[Any]]
    ) -> dict[int, np.ndarray | None]:
        """The next one."""
        return {slot: self._rest.pop(0) if self._rest else None for slot in runs}
