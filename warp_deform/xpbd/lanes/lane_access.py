"""One world's particle out of the lanes, for code that branches too differently to run in lanes.

Arrays of V3 are read through arrays of scalars on the same memory: taking one lane out of a loaded
V3 would load all lanes.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from .structures import structures

__all__ = ["lane_access"]


@functools.cache
def lane_access(scalar: Any, lanes: int) -> SimpleNamespace:
    """`get(x, i, lane)` and `put(x, i, lane, v)` for flat arrays of V3, `get_mass` and `put_scalar`
    of V; `count_one` counts a constraint that acted in one lane of the backward sweep,
    `count_lanes` an `amount` of them in the lanes that are `on`.
    """
    t = structures(scalar, lanes)
    S, V, R3, L, Adjoint = t.S, t.V, t.R3, t.L, t.Adjoint

    c_type = {wp.float32: "float", wp.float64: "double"}[scalar]
    at = f"{c_type}* p = x.data + (size_t)i * {3 * L} + lane;"

    # one address for three numbers: as indexed arrays, each would be computed from the strides
    @wp.func_native(f"{at} return wp::vec_t<3, {c_type}>(p[0], p[{L}], p[{2 * L}]);")
    def get(x: wp.array(dtype=S), i: int, lane: int) -> R3: ...

    @wp.func_native(f"{at} p[0] = v[0]; p[{L}] = v[1]; p[{2 * L}] = v[2];")
    def put(x: wp.array(dtype=S), i: int, lane: int, v: R3): ...

    @wp.func_native(f"return x.data[(size_t)i * {L} + lane];")
    def get_mass(x: wp.array(dtype=S), i: int, lane: int) -> S: ...

    @wp.func_native(f"x.data[(size_t)i * {L} + lane] = v;")
    def put_scalar(x: wp.array(dtype=S), i: int, lane: int, v: S): ...

    @wp.func
    def count_lanes(kind: int, on: V, amount: int, adj: Adjoint):
        adj.fired[kind] = adj.fired[kind] + on * S(amount)

    @wp.func
    def count_one(kind: int, lane: int, adj: Adjoint):
        fired = adj.fired[kind]
        fired[lane] = fired[lane] + S(1.0)
        adj.fired[kind] = fired

    return SimpleNamespace(
        get=get,
        put=put,
        get_mass=get_mass,
        put_scalar=put_scalar,
        count_one=count_one,
        count_lanes=count_lanes,
    )
