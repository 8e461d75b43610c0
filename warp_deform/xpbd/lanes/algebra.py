"""Lane algebra: the scalar of L worlds that one thread simulates side by side.

``V`` is one scalar of L worlds (a Warp vector of length L, so the compiler uses SIMD registers),
``V3`` one 3-vector of L worlds, stored as three V. ``+ - * /`` work lane by lane, so a constraint
reads like scalar code:

    lam = c / ((wi + wj + alpha) * max(l, eps))
    x[i] = xi - d * (lam * wi)

Each operation is the same IEEE operation in every lane, so a world's bits do not depend on L or on
its neighbours. Warp finds operators by name in the globals of the function that uses them, which is
why files that use the algebra import ``add, sub, mul, div`` though they never call them by name.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ...errors import InputError

__all__ = [
    "LANES",
    "PRECISIONS",
    "add",
    "any_less",
    "cross",
    "div",
    "dot",
    "kernel_options",
    "lane_types",
    "length",
    "less",
    "mul",
    "nonfinite",
    "root",
    "select",
    "sub",
]

LANES = (1, 4, 8, 16)
PRECISIONS = (wp.float32, wp.float64)

_KERNEL_OPTIONS: dict[str, Any] = {
    # no fused multiply-add: the same bits on every x86-64 processor
    "fuse_fp": False,
    "enable_backward": False,
    # loops stay loops: unrolled corner and axis loops would take long to compile
    "max_unroll": 1,
    # native: wide registers; inlining: a function that stays a call copies its structs (3 times
    # slower)
    "cpu_compiler_flags": "-march=native -mllvm -inline-threshold=20000",
}


def kernel_options(scalar: Any, lanes: int) -> dict[str, Any]:
    """Options of the modules of kernels over `scalar`s.

    Checks are what float64 without lanes is for, and they wait for the compiler more than they run:
    -O1 gives the same bits, compiles much sooner and runs a little slower.
    """
    for_checks = scalar == wp.float64 and lanes == 1
    return _KERNEL_OPTIONS | ({"optimization_level": 1} if for_checks else {})


_C_TYPE = {wp.float32: "float", wp.float64: "double"}
_C_SQRT = {wp.float32: "sqrtf", wp.float64: "sqrt"}


def _overloads(scalar: Any, lanes: int) -> tuple[SimpleNamespace, dict[str, list[Any]]]:
    """Types of one precision and width, and the functions that implement the algebra on them."""
    vector = wp.types.vector(lanes, scalar)
    c_type, c_sqrt = _C_TYPE[scalar], _C_SQRT[scalar]
    c_vector = f"wp::vec_t<{lanes}, {c_type}>"
    each = f"for (int i = 0; i < {lanes}; ++i)"

    @wp.struct
    class V3:
        x: vector
        y: vector
        z: vector

    @wp.func_native(f"{c_vector} r; {each} r.c[i] = {c_sqrt}(a.c[i]); return r;")
    def root(a: vector) -> vector: ...

    @wp.func_native(f"{c_vector} r; {each} r.c[i] = m.c[i] > 0 ? a.c[i] : b.c[i]; return r;")
    def select(m: vector, a: vector, b: vector) -> vector: ...

    @wp.func_native(f"{c_vector} r; {each} r.c[i] = a.c[i] < b.c[i] ? 1 : 0; return r;")
    def less(a: vector, b: vector) -> vector: ...

    @wp.func_native(f"bool r = false; {each} r |= a.c[i] < s; return r;")
    def any_less(a: vector, s: scalar) -> bool: ...

    @wp.func_native(f"{c_vector} r; {each} r.c[i] = (a.c[i] - a.c[i]) == 0 ? 0 : 1; return r;")
    def nonfinite(a: vector) -> vector: ...

    @wp.func
    def add(a: V3, b: V3):
        return V3(a.x + b.x, a.y + b.y, a.z + b.z)

    @wp.func
    def sub(a: V3, b: V3):
        return V3(a.x - b.x, a.y - b.y, a.z - b.z)

    @wp.func
    def mul_vector(a: V3, s: vector):
        return V3(wp.cw_mul(a.x, s), wp.cw_mul(a.y, s), wp.cw_mul(a.z, s))

    @wp.func
    def mul_scalar(a: V3, s: scalar):
        return V3(a.x * s, a.y * s, a.z * s)

    @wp.func
    def mul_lanes(a: vector, b: vector):
        return wp.cw_mul(a, b)

    @wp.func
    def div(a: vector, b: vector):
        return wp.cw_div(a, b)

    @wp.func
    def dot(a: V3, b: V3):
        return wp.cw_mul(a.x, b.x) + wp.cw_mul(a.y, b.y) + wp.cw_mul(a.z, b.z)

    @wp.func
    def length(a: V3):
        return root(wp.cw_mul(a.x, a.x) + wp.cw_mul(a.y, a.y) + wp.cw_mul(a.z, a.z))

    @wp.func
    def cross(a: V3, b: V3):
        return V3(
            wp.cw_mul(a.y, b.z) - wp.cw_mul(a.z, b.y),
            wp.cw_mul(a.z, b.x) - wp.cw_mul(a.x, b.z),
            wp.cw_mul(a.x, b.y) - wp.cw_mul(a.y, b.x),
        )

    types = SimpleNamespace(
        S=scalar,
        L=lanes,
        V=vector,
        V3=V3,
        R3=wp.types.vector(3, scalar),
        Q=wp.types.quaternion(scalar),
        M33=wp.types.matrix((3, 3), scalar),
    )
    functions = {
        "root": [root],
        "select": [select],
        "less": [less],
        "any_less": [any_less],
        "nonfinite": [nonfinite],
        "add": [add],
        "sub": [sub],
        "mul": [mul_vector, mul_scalar, mul_lanes],
        "div": [div],
        "dot": [dot],
        "length": [length],
        "cross": [cross],
    }
    return types, functions


@functools.cache
def _build() -> tuple[dict[tuple[Any, int], SimpleNamespace], dict[str, Any]]:
    """All precisions and widths as overloads of one function per name."""
    types: dict[tuple[Any, int], SimpleNamespace] = {}
    merged: dict[str, Any] = {}
    for scalar in PRECISIONS:
        for lanes in LANES:
            types[scalar, lanes], functions = _overloads(scalar, lanes)
            for name, variants in functions.items():
                for function in variants:
                    if name not in merged:
                        merged[name] = function
                    else:
                        for overload in list(function.user_overloads.values()):
                            merged[name].add_overload(overload)
    return types, merged


_TYPES, _MERGED = _build()
add, sub, mul, div = (_MERGED[name] for name in ("add", "sub", "mul", "div"))
dot, length, cross = (_MERGED[name] for name in ("dot", "length", "cross"))
root, select, less, any_less = (_MERGED[name] for name in ("root", "select", "less", "any_less"))
nonfinite = _MERGED["nonfinite"]


def lane_types(scalar: Any, lanes: int) -> SimpleNamespace:
    """Types for a precision and a width: S, L, V, V3, R3 (vec3), Q (quaternion), M33.

    Raises:
        InputError: the precision or the number of lanes is not one that is built.
    """
    if (scalar, lanes) not in _TYPES:
        raise InputError(f"lanes must be one of {LANES} and the scalar float32 or float64")
    return _TYPES[scalar, lanes]
