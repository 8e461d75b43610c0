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


_CHECKS: dict[str, Any] = {"optimization_level": 1, "cpu_compiler_flags": "-march=native"}
"""Checks are what float64 without lanes is for, and they wait for the compiler more than they run.
Without the inlining above, what has boxes compiles in three quarters of the time, and runs as fast.
"""


def kernel_options(scalar: Any, lanes: int) -> dict[str, Any]:
    """Options of the modules of kernels over `scalar`s; all of them give the same bits."""
    return _KERNEL_OPTIONS | (_CHECKS if scalar == wp.float64 and lanes == 1 else {})


_C_TYPE = {wp.float32: "float", wp.float64: "double"}
_C_SQRT = {wp.float32: "sqrtf", wp.float64: "sqrt"}


def _each_lane(scalar: Any, lanes: int, of_lane: str, at_once: str, taken: str = "ab") -> str:
    """C++ of a function of vectors: `of_lane` in terms of `$a`, or `at_once` of registers `A`.

    The compiler would find the registers behind loops, but takes a fifth of its time for that. Its
    types for them are Clang's, so CUDA has loops.
    """
    c_type = _C_TYPE[scalar]
    loop = f"for (int i = 0; i < {lanes}; ++i) r.c[i] = {of_lane};"
    for name in taken:
        loop = loop.replace(f"${name}", f"{name}.c[i]")
    body = [loop]
    if lanes > 1:
        kind = f"ext_vector_type({lanes}), aligned(alignof({c_type})), may_alias"
        read = ", ".join(f"{name.upper()} = *(const W*){name}.c" for name in taken)
        registers = f"typedef {c_type} W __attribute__(({kind})); const W {read};"
        body = ["#ifdef __CUDACC__", loop, "#else", f"{registers} *(W*)r.c = {at_once};", "#endif"]
    return "\n".join([f"wp::vec_t<{lanes}, {c_type}> r;", *body, "return r;"])


def _overloads(scalar: Any, lanes: int) -> tuple[SimpleNamespace, dict[str, list[Any]]]:
    """Types of one precision and width, and the functions that implement the algebra on them."""
    vector = wp.types.vector(lanes, scalar)
    each = functools.partial(_each_lane, scalar, lanes)

    @wp.struct
    class V3:
        x: vector
        y: vector
        z: vector

    @wp.func_native(each(f"{_C_SQRT[scalar]}($a)", "__builtin_elementwise_sqrt(A)", "a"))
    def root(a: vector) -> vector: ...

    @wp.func_native(each("$m > 0 ? $a : $b", "M > (W)0 ? A : B", "mab"))
    def select(m: vector, a: vector, b: vector) -> vector: ...

    @wp.func_native(each("$a < $b ? 1 : 0", "A < B ? (W)1 : (W)0"))
    def less(a: vector, b: vector) -> vector: ...

    @wp.func_native(f"bool r = false; for (int i = 0; i < {lanes}; ++i) r |= a.c[i] < s; return r;")
    def any_less(a: vector, s: scalar) -> bool: ...

    @wp.func_native(each("($a - $a) == 0 ? 0 : 1", "(A - A) == (W)0 ? (W)0 : (W)1", "a"))
    def nonfinite(a: vector) -> vector: ...

    @wp.func_native(each("$a + $b", "A + B"))
    def add_lanes(a: vector, b: vector) -> vector: ...

    @wp.func_native(each("$a - $b", "A - B"))
    def sub_lanes(a: vector, b: vector) -> vector: ...

    @wp.func_native(each("$a * $b", "A * B"))
    def mul_lanes(a: vector, b: vector) -> vector: ...

    @wp.func_native(each("$a / $b", "A / B"))
    def div(a: vector, b: vector) -> vector: ...

    @wp.func_native(each("$a * s", "A * (W)s", "a"))
    def mul_lanes_scalar(a: vector, s: scalar) -> vector: ...

    @wp.func
    def add(a: V3, b: V3):
        return V3(add_lanes(a.x, b.x), add_lanes(a.y, b.y), add_lanes(a.z, b.z))

    @wp.func
    def sub(a: V3, b: V3):
        return V3(sub_lanes(a.x, b.x), sub_lanes(a.y, b.y), sub_lanes(a.z, b.z))

    @wp.func
    def mul_vector(a: V3, s: vector):
        return V3(mul_lanes(a.x, s), mul_lanes(a.y, s), mul_lanes(a.z, s))

    @wp.func
    def mul_scalar(a: V3, s: scalar):
        return V3(mul_lanes_scalar(a.x, s), mul_lanes_scalar(a.y, s), mul_lanes_scalar(a.z, s))

    @wp.func
    def dot(a: V3, b: V3):
        return add_lanes(add_lanes(mul_lanes(a.x, b.x), mul_lanes(a.y, b.y)), mul_lanes(a.z, b.z))

    @wp.func
    def length(a: V3):
        return root(dot(a, a))

    @wp.func
    def cross(a: V3, b: V3):
        return V3(
            sub_lanes(mul_lanes(a.y, b.z), mul_lanes(a.z, b.y)),
            sub_lanes(mul_lanes(a.z, b.x), mul_lanes(a.x, b.z)),
            sub_lanes(mul_lanes(a.x, b.y), mul_lanes(a.y, b.x)),
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
        "add": [add, add_lanes],
        "sub": [sub, sub_lanes],
        "mul": [mul_vector, mul_scalar, mul_lanes, mul_lanes_scalar],
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
