"""What presses a layer onto the table: in contacts of fabrics, the table's share of the answer.

A pass solves contacts first and the table after them. A contact that shares its correction with
particles that lie on the table would be half undone there, and whatever presses hard enough goes
through the layers below. So contacts see such particles where the table will put them, and count on
it to carry what presses them down; the correction that they get passes the load on to the table and
its friction. In the air nothing changes.

Source: mass scaling for stacks in Macklin et al., "Unified Particle Physics for Real-Time
Applications", 2014, here by what the table holds instead of by height.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..lanes.structures import structures

__all__ = ["CARRIED", "table_support"]

CARRIED = 0.9
"""Share of what presses straight down that the table takes at once: with all of it, what is pressed
between the table and a grip would be flung aside."""


@functools.cache
def table_support(scalar: Any, lanes: int) -> SimpleNamespace:
    """`raised(x, radius)`: where the table will put a particle that is at x.

    `carried(way, z, x, w)`: its inverse mass w if that place z is above x and the contact moves it
    down (`way` < 0), else 0. `unraised(g, z, x)`: a derivative g by z as one by x.
    """
    t = structures(scalar, lanes)
    S, R3 = t.S, t.R3

    @wp.func
    def raised(x: R3, radius: S):
        return R3(x[0], x[1], wp.max(x[2], radius))

    @wp.func
    def carried(way: S, z: R3, x: R3, w: S):
        return wp.where(way < S(0.0) and z[2] > x[2], w, S(0.0))

    @wp.func
    def unraised(g: R3, z: R3, x: R3):
        return R3(g[0], g[1], wp.where(z[2] > x[2], S(0.0), g[2]))

    return SimpleNamespace(raised=raised, carried=carried, unraised=unraised)
