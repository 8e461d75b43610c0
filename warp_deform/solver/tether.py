"""Tethers: nothing of a fabric is farther from the held vertex than along the fabric.

One iteration a substep carries a pull one spring further, so a heavy sheet that hangs from a vertex
would stretch about it. A tether bounds every vertex's distance from the held one by the length of
the shortest way along the springs at their strain limits.

Source: Kim, Chentanez, Mueller, "Long Range Attachments", 2012.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from .lanes import add, any_less, div, dot, less, mul, root, select, sub  # noqa: F401
from .structures import structures

__all__ = ["NO_TETHER", "tether"]

NO_TETHER = 1.0e6
"""Length [m] where a particle has no tether; its square is finite in float32."""


@functools.cache
def tether(scalar: Any, lanes: int) -> SimpleNamespace:
    """`project_tether(i, holding, held, q)`: bring particle i back to its tether's length from what
    is held, in the lanes that hold something.
    """
    t = structures(scalar, lanes)
    S, V, V3, Particles = t.S, t.V, t.V3, t.Particles

    @wp.func
    def project_tether(i: int, holding: V, held: V3, q: Particles):
        longest = select(holding, q.tether[i], V(S(NO_TETHER)))
        x = q.x[i]
        d = x - held
        l2 = dot(d, d)
        if any_less(longest * longest - l2, S(0.0)):
            over = less(longest * longest, l2) * less(V(S(0.0)), q.w[i])
            y = held + d * (longest / wp.max(root(l2), V(S(1.0e-12))))
            # rounding must not move what is within reach
            q.x[i] = V3(select(over, y.x, x.x), select(over, y.y, x.y), select(over, y.z, x.z))

    return SimpleNamespace(project_tether=project_tether)
