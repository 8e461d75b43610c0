"""How a bead chain may lie: straight, along a smooth curve, or lightly tossed."""

from __future__ import annotations

import numpy as np

from ..errors import WarpDeformError
from ..objects.cable import CableConfig

__all__ = ["curved_chain", "straight_chain", "tossed_chain"]

_DRAWS = 1000
_FREQUENCIES = (0.5, 1.0, 1.5)


def straight_chain(config: CableConfig, middle: np.ndarray, yaw: float) -> np.ndarray:
    """Bead centres (n, 3) [m] of a straight chain on the ground about `middle` (2,) at `yaw`."""
    along = (np.arange(config.beads) - (config.beads - 1) / 2) * config.spacing
    xy = np.asarray(middle)[:2] + along[:, None] * [np.cos(yaw), np.sin(yaw)]
    return np.column_stack([xy, np.full(config.beads, config.radius)])


def curved_chain(
    rng: np.random.Generator,
    config: CableConfig,
    x: tuple[float, float],
    y: tuple[float, float],
    *,
    bend: float,
    margin: float = 0.02,
    lone: bool = True,
) -> np.ndarray:
    """Bead centres (n, 3) [m] along a random smooth curve within the rectangle less its margin.

    Args:
        bend: how strongly it turns; 0 is a straight line, at 4 most curves make a full turn
        lone: whether the chain must not come near itself

    Raises:
        WarpDeformError: no such curve fits.
    """
    s = np.linspace(0.0, 1.0, config.beads)
    low, high = np.array([x[0], y[0]]) + margin, np.array([x[1], y[1]]) - margin
    for _ in range(_DRAWS):
        waves = [rng.normal() * np.sin(2 * np.pi * (f * s + rng.random())) for f in _FREQUENCIES]
        yaw = rng.uniform(-np.pi, np.pi) + bend * np.cumsum(np.sum(waves, axis=0)) / config.beads
        steps = config.spacing * np.column_stack([np.cos(yaw), np.sin(yaw)])
        points = np.cumsum(steps, axis=0)
        size = np.ptp(points, axis=0)
        room = high - low - size
        if (room < 0).any() or (lone and not _apart(points, 6 * config.radius)):
            continue
        points += low + rng.uniform(0.0, 1.0, 2) * room - points.min(axis=0)
        return np.column_stack([points, np.full(config.beads, config.radius)])
    raise WarpDeformError(f"no chain of {config.length:.2f} m fits {x} x {y} m; enlarge it")


def tossed_chain(
    rng: np.random.Generator,
    config: CableConfig,
    x: tuple[float, float],
    y: tuple[float, float],
) -> np.ndarray:
    """Bead centres (n, 3) [m] of a chain about to fall: strongly bent, its strands may cross.

    Later beads are higher, so that what crosses comes to lie on top.
    """
    beads = curved_chain(rng, config, x, y, bend=7.0, margin=0.03, lone=False)
    beads[:, 2] += np.linspace(0.0, 0.03, config.beads) + 0.01
    return beads


def _apart(points: np.ndarray, gap: float) -> bool:
    """Whether parts of a curve (n, 2) that are not neighbours stay `gap` [m] apart."""
    distance = np.linalg.norm(points[:, None] - points[None], axis=-1)
    step = float(np.linalg.norm(points[1] - points[0]))
    along = np.abs(np.subtract.outer(np.arange(len(points)), np.arange(len(points)))) * step
    return bool((distance[along > 2.5 * gap] > gap).all())
