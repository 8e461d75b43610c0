"""Sorts points into square cells in the plane, so that what is near a point is found in few runs.

Fabrics lie on a table, so cells in x and y suffice. Points of one row of cells lie side by side in
memory: a search reads one run per row, without following links.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..lanes.structures import structures

__all__ = ["RUN", "cell_sort"]

RUN = 31
"""Points that `hits_in_ball` looks at: one bit each of an int."""


@functools.cache
def cell_sort(scalar: Any, lanes: int) -> SimpleNamespace:
    """`sort_cells(...)`, `cell_of(x, low, inverse, grid)`: row or column of a coordinate.

    `sort_cells` takes points `points[links:links + count]` in the box from `low` to `high`, with
    cells of side 1 / inverse from `low` on. Cell c = row * grid + column holds the points
    `links + head[heads + c]` to `links + head[heads + c + 1]` of `sorted`, and of `key` their
    numbers n, as -1 - n where `moved[links + n]` is 0.

    `hits_in_ball(x, key, at, end, b, below)`: which of the next RUN points of x, which is `sorted`,
    as bits, reach the ball b (both have their fourth number as radius) and have a key less than
    `below`.
    `hits_in_box` likewise, in the box from l to h, with keys of at least `least`. `first_hit` is
    the lowest of the bits.
    """
    t = structures(scalar, lanes)
    S, R3, V4 = t.S, t.R3, t.V4

    @wp.func
    def cell_of(x: S, low: S, inverse: S, grid: int):
        return wp.clamp(int((x - low) * inverse), 0, grid - 1)

    @wp.func
    def inside(p: V4, low: R3, high: R3):
        return (
            p[0] >= low[0]
            and p[0] <= high[0]
            and p[1] >= low[1]
            and p[1] <= high[1]
            and p[2] >= low[2]
            and p[2] <= high[2]
        )

    @wp.func
    def sort_cells(
        heads: int,
        grid: int,
        links: int,
        count: int,
        low: R3,
        high: R3,
        inverse: S,
        points: wp.array(dtype=V4),
        moved: wp.array(dtype=int),
        head: wp.array(dtype=int),
        key: wp.array(dtype=int),
        sorted: wp.array(dtype=V4),
    ):
        for at in range(grid * grid + 1):
            head[heads + at] = 0
        for n in range(count):
            p = points[links + n]
            if inside(p, low, high):
                row = cell_of(p[0], low[0], inverse, grid)
                at = heads + row * grid + cell_of(p[1], low[1], inverse, grid)
                head[at] = head[at] + 1
        # ends of the cells, which become their starts as the cells fill from behind
        end = int(0)
        for at in range(grid * grid + 1):
            end += head[heads + at]
            head[heads + at] = end
        for n in range(count):
            p = points[links + n]
            if inside(p, low, high):
                row = cell_of(p[0], low[0], inverse, grid)
                at = heads + row * grid + cell_of(p[1], low[1], inverse, grid)
                to = head[at] - 1
                head[at] = to
                sorted[links + to] = p
                key[links + to] = wp.where(moved[links + n] > 0, n, -1 - n)

    # Searches spend their time here. Without branches: which points are hits cannot be foreseen.
    c_type = {wp.float32: "float", wp.float64: "double"}[scalar]

    @wp.func_native(f"""
        const int count = end - at < {RUN} ? end - at : {RUN};
        unsigned hits = 0;
        for (int k = 0; k < count; ++k) {{
            const wp::vec_t<4, {c_type}>& o = x.data[at + k];
            const {c_type} p[] = {{o[0] - b[0], o[1] - b[1], o[2] - b[2], o[3] + b[3]}};
            const bool in = p[0] * p[0] + p[1] * p[1] + p[2] * p[2] < p[3] * p[3];
            hits |= (unsigned)(in & (key.data[at + k] < below)) << k;
        }}
        return (int)hits;""")
    def hits_in_ball(
        x: wp.array(dtype=V4), key: wp.array(dtype=int), at: int, end: int, b: V4, below: int
    ) -> int: ...

    on_device, on_host = "return __ffs(hits) - 1;", "return __builtin_ctz((unsigned)hits);"

    @wp.func_native(f"#if defined(__CUDA_ARCH__)\n{on_device}\n#else\n{on_host}\n#endif\n")
    def first_hit(hits: int) -> int: ...

    @wp.func_native(f"""
        const int count = end - at < {RUN} ? end - at : {RUN};
        unsigned hits = 0;
        for (int k = 0; k < count; ++k) {{
            const auto& o = x.data[at + k];
            const bool in = (o[2] > l[2]) & (o[2] < h[2]) & (o[0] > l[0]) & (o[0] < h[0])
                & (o[1] > l[1]) & (o[1] < h[1]);
            hits |= (unsigned)(in & (key.data[at + k] >= least)) << k;
        }}
        return (int)hits;""")
    def hits_in_box(
        x: wp.array(dtype=V4), key: wp.array(dtype=int), at: int, end: int, l: R3, h: R3, least: int
    ) -> int: ...

    return SimpleNamespace(
        cell_of=cell_of,
        sort_cells=sort_cells,
        first_hit=first_hit,
        hits_in_ball=hits_in_ball,
        hits_in_box=hits_in_box,
    )
