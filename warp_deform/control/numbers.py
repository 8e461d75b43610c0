"""The numbers that tell a state under control: what environments show and what episodes hold."""

from __future__ import annotations

import numpy as np

from ..episodes import Episode
from ..errors import InputError

__all__ = ["control_numbers", "recorded_numbers"]


def control_numbers(
    *,
    tip: np.ndarray,
    holding: bool,
    particle_q: np.ndarray,
    particle_qd: np.ndarray,
    body_q: np.ndarray,
    goal: np.ndarray,
    time: float,
) -> dict[str, np.ndarray]:
    """The entries of the observation "state_dict"; particles are told relative to the tip.

    Args:
        tip: x, y, z [m], yaw [rad] (4,)
        particle_q: (P, 3) [m]
        particle_qd: (P, 3) [m/s]
        body_q: (B, 7)
        goal: what the task aims at
        time: share of the steps that are used up
    """
    return {
        "tip": tip,
        "holding": np.array([float(holding)]),
        "particle_q": particle_q - tip[:3],
        "particle_qd": particle_qd,
        "body_q": body_q,
        "goal": goal,
        "time": np.array([time]),
    }


def recorded_numbers(episode: Episode) -> np.ndarray:
    """The observations "state" (T + 1, D) float32 of a recorded episode, to the bit.

    Raises:
        InputError: the episode is of picks and places.
    """
    record = episode.info.control
    if record is None:
        raise InputError(f"the episode of seed {episode.info.seed} is no control at a fixed rate")
    rows = []
    for t, step in enumerate(episode.steps):
        assert step.control is not None, "rows of control have a tip"
        numbers = control_numbers(
            tip=step.control.tip,
            holding=step.control.holding,
            particle_q=step.particle_q,
            particle_qd=step.particle_qd,
            body_q=step.body_q,
            goal=record.goal,
            time=t / record.horizon,
        )
        flat = [np.asarray(array, np.float32).ravel() for array in numbers.values()]
        rows.append(np.concatenate(flat))
    return np.stack(rows)
