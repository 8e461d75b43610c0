"""What a page is told of the present state of worlds: numbers, words, and what to draw."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..tasks.task import Snapshot
from ..worlds.worlds import Worlds
from .drawing import drawable_arrays, link_matrices, pictures
from .fault import Fault
from .measures import measures

__all__ = ["scene_arrays", "state_head", "state_pictures", "why_over"]


def why_over(worlds: Worlds) -> str:
    """Why nothing more is to be done in slot 0, empty while something is."""
    episode = worlds.episodes[0]
    if not episode.physics_ok:
        return "the physics broke"
    if worlds.solved(0):
        return "solved"
    if episode.ended:
        return "over without success"
    if len(episode.history) >= worlds.task.max_actions:
        return f"not solved in {worlds.task.max_actions} actions"
    return ""


def state_head(worlds: Worlds, fault: Fault | None) -> dict[str, Any]:
    """What is told of slot 0, as JSON.

    Args:
        fault: where its physics broke, as far as that is known
    """
    episode = worlds.episodes[0]
    ok = episode.physics_ok
    problems = [] if ok else [*map(str, episode.problems), *([fault.says] if fault else [])]
    return {
        "seed": episode.seed,
        "score": float(worlds.score(0)),
        "measures": measures(worlds.task, episode) if ok else {},
        "solved": worlds.solved(0),
        "over": why_over(worlds),
        "physics": "; ".join(problems),
        "fault": list(fault.at) if fault and not ok else None,
        "most": worlds.task.max_actions,
        "seconds": float(episode.sim_seconds),
        "hash": worlds.hash(0),
    }


def scene_arrays(worlds: Worlds, last: Snapshot | None = None) -> dict[str, np.ndarray]:
    """Arrays that show slot 0 as it stands.

    Args:
        last: is shown instead of a state that is not finite
    """
    episode = worlds.episodes[0]
    shown = episode.snapshot
    if last is not None and not (
        np.isfinite(shown.particle_q).all() and np.isfinite(shown.body_q).all()
    ):
        shown = last
    return {
        **drawable_arrays(episode.drawables),
        "q": shown.particle_q.astype(np.float32),
        "body": shown.body_q.astype(np.float32),
        "links": link_matrices(worlds.robot, episode.posture[None]),
    }


def state_pictures(worlds: Worlds, *, height: bool = True) -> dict[str, np.ndarray]:
    """The observation of slot 0 where it can be trusted, and the goal where there is one."""
    episode = worlds.episodes[0]
    goal = episode.goal.color if episode.goal is not None else None
    if not episode.physics_ok:
        return pictures(goal=goal)
    images = episode.snapshot.images
    return pictures(images.color, images.height if height else None, goal)
