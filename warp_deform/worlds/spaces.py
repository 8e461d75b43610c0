"""What an agent does and sees, as Gymnasium spaces and dictionaries of one running episode."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike

from ..episodes import MAX_HEIGHT
from ..errors import InputError
from ..rendering.images import Images
from ..rendering.pixels import BOUNDS, SHAPE
from ..robots.primitive import LIFT, Outcome
from ..support.checked import real_array
from ..tasks.task import Task
from .worlds import Worlds

__all__ = ["action_space", "check_action", "information", "observation", "observation_space"]

_NAMES = ("pick x", "pick y", "pick yaw", "place x", "place y", "place yaw", "lift")
_POSE = (*BOUNDS[:2], (-np.pi, np.pi))
_EXACT = np.array([*_POSE, *_POSE, LIFT])
# A policy computes in float32: a limit rounded to float32 still lies within the space.
_LOW = np.minimum(_EXACT[:, 0], _EXACT[:, 0].astype(np.float32))
_HIGH = np.maximum(_EXACT[:, 1], _EXACT[:, 1].astype(np.float32))
# One rounding step of float32 at the limits, with a hair for rounding in float64.
_STEP = np.spacing(np.abs(_EXACT).max(axis=1).astype(np.float32)).astype(float) * (1 + 1e-6)


def action_space() -> spaces.Box:
    """Box (7,) float64: pick x, y [m], yaw [rad], place x, y, yaw, lift [m], on the workspace."""
    return spaces.Box(_LOW, _HIGH, dtype=np.float64)


def observation_space(task: Task) -> spaces.Dict:
    """Images: color (320, 160, 3) uint8 and height (320, 160) float32 [m]; with a goal also its."""
    color = spaces.Box(0, 255, (*SHAPE, 3), np.uint8)
    height = spaces.Box(0.0, MAX_HEIGHT, SHAPE, np.float32)
    seen: dict[str, spaces.Space[Any]] = {"color": color, "height": height}
    if task.goal_conditioned:
        seen |= {"goal_color": color, "goal_height": height}
    return spaces.Dict(seen)


def check_action(action: ArrayLike, *, name: str = "action") -> np.ndarray:
    """The action as (7,) float64: what the action space holds unchanged, what is one rounding step
    beyond it on its limit.

    A policy, or a wrapper that rescales its output, computes in float32 and may round a limit
    outwards; nothing else is clamped.

    Raises:
        InputError: another shape, no real numbers, or a value beyond the action space.
    """
    values = real_array(action, _LOW.shape, name=name)
    for what, value, low, high, step in zip(_NAMES, values, _LOW, _HIGH, _STEP, strict=True):
        if not low - step <= value <= high + step:  # also when it is not a number
            unit = "rad" if what.endswith("yaw") else "m"
            raise InputError(
                f"{name}: {what} is {value:.6g} {unit}, allowed are {low:.6g} to {high:.6g}"
            )
    return np.clip(values, _LOW, _HIGH)


def observation(worlds: Worlds, slot: int) -> dict[str, np.ndarray]:
    """What an agent sees of a slot: new arrays, which the caller may change.

    The images of a state that cannot be drawn are zero; its `physics_ok` is False.
    """
    images = _images(worlds, slot)
    seen = {"color": images.color.copy(), "height": images.height.copy()}
    if worlds.task.goal_conditioned:
        goal = worlds.episodes[slot].goal
        assert goal is not None, "Worlds gives every episode of such a task a goal"
        seen |= {"goal_color": goal.color.copy(), "goal_height": goal.height.copy()}
    return seen


def information(
    worlds: Worlds, slot: int, *, outcome: Outcome | None, stage_rule: str = "action"
) -> dict[str, Any]:
    """What is known about a slot's episode beyond the observation; not for policies.

    success and is_success (both spellings are in use), score in [0, 1], physics_ok, problems (why
    the physics cannot be trusted, "" when it can), state_hash, sim_seconds [s], at_rest (whether
    things came to rest after the last motion), seed, discarded_starts, actions so far, outcome of
    the last one ("" after a reset), enclosed (only where a bag is to keep items: whether it does,
    see `Task.enclosed`), stage_rule (who chose the lift), ground_truth (D,) float32,
    segmentation (320, 160) uint8.
    """
    episode = worlds.episodes[slot]
    success = bool(worlds.solved(slot))
    enclosed = worlds.enclosed(slot)
    return {
        "success": success,
        "is_success": success,
        "score": float(worlds.score(slot)),
        "physics_ok": bool(episode.physics_ok),
        "problems": "; ".join(map(str, episode.problems)),
        "state_hash": worlds.hash(slot),
        "sim_seconds": float(episode.sim_seconds),
        "at_rest": bool(episode.at_rest),
        "seed": int(episode.seed),
        "discarded_starts": int(episode.discarded_starts),
        "actions": len(episode.history),
        "outcome": outcome.value if outcome is not None else "",
        **({} if enclosed is None else {"enclosed": enclosed}),
        "stage_rule": stage_rule,
        "ground_truth": worlds.task.ground_truth(episode.layout, episode.snapshot),
        "segmentation": _images(worlds, slot).segmentation.copy(),
    }


def _images(worlds: Worlds, slot: int) -> Images:
    snapshot = worlds.episodes[slot].snapshot
    if np.isfinite(snapshot.particle_q).all() and np.isfinite(snapshot.body_q).all():
        return snapshot.images
    return Images(
        np.zeros((*SHAPE, 3), np.uint8), np.zeros(SHAPE, np.float32), np.zeros(SHAPE, np.uint8)
    )
