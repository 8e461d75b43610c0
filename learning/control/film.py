"""A video of test episodes that a control run's policy plays."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from warp_deform.collecting.control_episodes import (
    ControlSetup,
    control_worlds,
    play_control_episodes,
    record_control,
)
from warp_deform.collecting.control_video import film_control_episodes
from warp_deform.control.registry import control_task
from warp_deform.episodes import Episode
from warp_deform.errors import WarpDeformError

from .actor import Actor, PlanActor
from .demonstrate import POLICY, Acting

__all__ = ["film_played"]


def film_played(
    path: Path, actor: Actor | PlanActor, task: str, *, seeds: Sequence[int], horizon: int | None
) -> None:
    """Write an MP4 of the episodes of seeds, each to its end, one after the other.

    Args:
        horizon: control steps of an episode; None: the task's

    Raises:
        InputError: the path does not end with .mp4 or cannot be written.
        WarpDeformError: a seed has no valid start.
    """
    how = ControlSetup(type(control_task(task)), start="held", horizon=horizon)
    film_control_episodes([[_played(actor, how, seed)] for seed in seeds], path)


def _played(actor: Actor | PlanActor, how: ControlSetup, seed: int) -> Episode:
    """One episode, as recordings have it."""
    control = control_worlds(how)
    played = play_control_episodes(
        control, [seed], start=lambda runs: None, act=Acting(actor, control)
    )
    ((slot, run),) = played
    if not run.rows:
        raise WarpDeformError(f"the episode of seed {seed} cannot be filmed: {run.ended}")
    return record_control(control, slot, run, demonstrator=POLICY, pictures=False)
