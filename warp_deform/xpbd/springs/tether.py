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

from ..lanes.algebra import add, any_less, div, dot, less, mul, root, select, sub  # noqa: F401
from ..lanes.structures import structures
from ..lanes.tape import Kind

__all__ = ["NO_TETHER", "tether", "tether_adjoint"]

NO_TETHER = 1.0e6
"""Length [m] where a particle has no tether; its square is finite in float32."""


@functools.cache
def tether(scalar: Any, lanes: int) -> SimpleNamespace:
    """`project_tether(i, holding, held, particles)`: bring particle i back to its tether's length
    from what is held, in the lanes that hold something; returns whether it was farther in any lane.
    """
    t = structures(scalar, lanes)
    S, V, V3, Particles = t.S, t.V, t.V3, t.Particles

    @wp.func
    def project_tether(i: int, holding: V, held: V3, particles: Particles):
        longest = select(holding, particles.tether[i], V(S(NO_TETHER)))
        x = particles.x[i]
        d = x - held
        l2 = dot(d, d)
        pulls = any_less(longest * longest - l2, S(0.0))
        if pulls:
            over = less(longest * longest, l2) * less(V(S(0.0)), particles.w[i])
            y = held + d * (longest / wp.max(root(l2), V(S(1.0e-12))))
            # rounding must not move what is within reach
            particles.x[i] = V3(
                select(over, y.x, x.x), select(over, y.y, x.y), select(over, y.z, x.z)
            )
        return pulls

    return SimpleNamespace(project_tether=project_tether)


@functools.cache
def tether_adjoint(scalar: Any, lanes: int) -> SimpleNamespace:
    """`record_tether` leaves the offset from what is held on the tape, `sweep_tether` takes it back
    and returns the derivatives by the position of what is held. Branch: within reach or not.
    """
    t = structures(scalar, lanes)
    S, V, V3, Particles, Tape, Adjoint = t.S, t.V, t.V3, t.Particles, t.Tape, t.Adjoint
    project_tether = tether(scalar, lanes).project_tether

    @wp.func
    def record_tether(i: int, at: int, holding: V, held: V3, particles: Particles, tape: Tape):
        tape.x[at] = particles.x[i] - held
        return project_tether(i, holding, held, particles)

    @wp.func
    def sweep_tether(
        i: int, d: V3, holding: V, counts: int, on: V, particles: Particles, adj: Adjoint
    ):
        longest = select(holding, particles.tether[i], V(S(NO_TETHER)))
        l2 = dot(d, d)
        over = less(longest * longest, l2) * less(V(S(0.0)), adj.w[i])
        kind = counts + wp.static(int(Kind.TETHER))
        adj.fired[kind] = adj.fired[kind] + over * on
        g = adj.x[i]
        taken = g * over
        inverse = V(S(1.0)) / wp.max(root(l2), V(S(1.0e-12)))
        n = d * inverse
        given = (taken - n * dot(n, taken)) * (longest * inverse)
        adj.x[i] = g - taken + given
        return taken - given

    return SimpleNamespace(record_tether=record_tether, sweep_tether=sweep_tether)
