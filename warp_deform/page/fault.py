"""Where the physics broke, as far as the recorded motion tells."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..rendering.drawables import Drawables

__all__ = ["Fault", "where_it_broke"]


@dataclass(frozen=True)
class Fault:
    """A place that the page marks.

    Attributes:
        at: x, y, z [m]
        says: a line about it
    """

    at: tuple[float, float, float]
    says: str


def where_it_broke(drawables: Drawables, q: np.ndarray, interval: float) -> Fault | None:
    """The place and time at which a link or an edge was longest for its length at first.

    The guards themselves watch every substep and name no place.

    Args:
        q: positions of the particles in every recorded frame (T, P, 3) [m]
        interval: between frames [s]

    Returns:
        None where there is neither link nor edge
    """
    faces = drawables.triangle_particle
    edges = np.concatenate(
        [drawables.link_particle, *(faces[:, [k, (k + 1) % 3]] for k in range(3))]
    )
    if not len(edges) or not len(q):
        return None
    lengths = np.linalg.norm(q[:, edges[:, 0]] - q[:, edges[:, 1]], axis=-1)
    stretch = lengths / np.maximum(lengths[0], 1e-9)
    frame, edge = np.unravel_index(np.argmax(stretch), stretch.shape)
    x, y, z = map(float, q[frame, edges[edge]].mean(axis=0))
    says = (
        f"longest for its length, by {stretch[frame, edge]:.2f}, near x {x:.3f}, y {y:.3f}, "
        f"z {z:.3f} m, {frame * interval:.1f} s into the action"
    )
    return Fault((x, y, z), says)
