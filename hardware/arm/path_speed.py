"""How fast joints may go along a path so that the tool centre point keeps its speeds.

A share of the joints' greatest speeds says nothing about the hand: that depends on the posture. All
backends go through waypoints alike: between two of them the joints move in proportion, none faster
than its share, and one of them at it unless the arm speeds up or slows down. A gentle corner may be
rounded; there they move in a mixture of the proportions before and after it. So at a full share the
hand's greatest velocity at a place is known, and it falls in proportion with the share.

Source of the mixture: Kunz and Stilman, "Time-Optimal Trajectory Generation for Path Following with
Bounded Acceleration and Velocity", RSS 2012, section V (circular blends).
"""

from __future__ import annotations

import numpy as np

from .joint_path import SHARP
from .panda import DQ_MAX

__all__ = ["MAX_TURN_SPEED", "OVERSHOOT", "fitting_share"]

MAX_TURN_SPEED = 0.5
"""Speed at which the hand turns, at most [rad/s]."""
OVERSHOOT = 1.2
"""Greatest over planned speed: the vendor's controller overshoots by up to 16 % when it sets off,
and between two samples of a path the speed varies by some per cent."""
_MIXTURES = (0.25, 0.5, 0.75)


def fitting_share(
    q: np.ndarray,
    base_T_tcp: np.ndarray,
    *,
    max_speed: float,
    max_descent_speed: float = np.inf,
    max_turn_speed: float = MAX_TURN_SPEED,
) -> float:
    """Return the greatest share of the joints' speeds at which the TCP keeps its own.

    Args:
        q: joint positions along the path [rad], so dense that the speed hardly varies between two,
            (N, 7)
        base_T_tcp: the poses there, (N, 4, 4)
        max_speed: of the TCP [m/s]
        max_descent_speed: of the TCP downwards [m/s]
        max_turn_speed: of the hand's orientation [rad/s]

    Returns:
        the share, which may exceed 1; infinity for a path on which the TCP does not move
    """
    steps = np.diff(q, axis=0)
    seconds = (np.abs(steps) / DQ_MAX).max(axis=1)
    moving = seconds > 0.0
    steps, seconds = steps[moving], seconds[moving]
    apart = np.diff(base_T_tcp[:, :3, :], axis=0)[moving]
    directions = steps / seconds[:, None]
    velocities = apart[:, :, 3] / seconds[:, None]
    chords = np.linalg.norm(apart[:, :, :3], axis=(1, 2)) / np.sqrt(8.0)
    turns = 2.0 * np.arcsin(np.clip(chords, 0.0, 1.0)) / seconds
    all_velocities, all_turns = [velocities], [turns]
    lengths = np.linalg.norm(directions, axis=1)
    cosines = (directions[1:] * directions[:-1]).sum(axis=1) / (lengths[1:] * lengths[:-1])
    gentle = cosines >= SHARP
    for b in _MIXTURES:
        a = 1.0 - b
        mixed = (a * directions[:-1] + b * directions[1:])[gentle]
        slower = (np.abs(mixed) / DQ_MAX).max(axis=1)
        mean = (a * velocities[:-1] + b * velocities[1:])[gentle]
        all_velocities.append(mean / slower[:, None])
        all_turns.append((a * turns[:-1] + b * turns[1:])[gentle] / slower)
    v, turn = np.concatenate(all_velocities), np.concatenate(all_turns)
    used = (
        np.linalg.norm(v, axis=1) / max_speed,
        -v[:, 2] / max_descent_speed,
        turn / max_turn_speed,
    )
    greatest = max((float(share.max(initial=0.0)) for share in used), default=0.0)
    return 1.0 / (OVERSHOOT * greatest) if greatest > 0.0 else float("inf")
