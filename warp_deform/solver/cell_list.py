"""Which particles may touch which triangles soon: a cell list in the plane, one world at a time.

Fabrics lie on a table, so cells in x and y suffice. A world lists anew when one of its particles
has gone half the margin since the last listing, so that no pair can come to touch unlisted (Verlet,
1967); the order of the list follows from the world's own positions only.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from .closest_point import closest_point
from .lane_access import lane_access
from .lanes import add, dot, mul, sub  # noqa: F401  (operators are found by name)
from .structures import structures

__all__ = ["cell_list"]


@functools.cache
def cell_list(scalar: Any, lanes: int) -> SimpleNamespace:
    """`moved_since(p0, n, q, cells)` and `list_triangles(...)`.

    `moved_since` is the largest squared way of a particle since its world's last listing, by lane.
    `list_triangles` makes the list of one lane and returns how many pairs found no room in it.
    """
    t = structures(scalar, lanes)
    S, V, R3, L = t.S, t.V, t.R3, t.L
    Topology, Sheets, Cells, Particles = t.Topology, t.Sheets, t.Cells, t.Particles
    get, put = lane_access(scalar, lanes).get, lane_access(scalar, lanes).put
    barycentric = closest_point(scalar, lanes).barycentric

    @wp.func
    def moved_since(p0: int, n: int, q: Particles, cells: Cells):
        worst = V(S(0.0))
        for i in range(p0, p0 + n):
            d = q.x[i] - cells.xr[i]
            worst = wp.max(worst, dot(d, d))
        return worst

    @wp.func
    def cell_of(x: S, low: S, inverse: S, grid: int):
        return wp.clamp(int((x - low) * inverse), 0, grid - 1)

    @wp.func
    def excluded(i: int, tri: wp.vec3i, base: int, sheets: Sheets):
        """Whether particle and triangle are too close in the rest shape to be able to collide."""
        close = bool(False)
        if sheets.owner[base + i] == sheets.owner[base + tri[0]]:
            reach = sheets.exclusion[base + i]
            r = sheets.rest[base + i]
            for corner in range(3):
                d = r - sheets.rest[base + tri[corner]]
                if wp.dot(d, d) <= reach * reach:
                    close = True
        return close

    @wp.func
    def list_triangles(
        g: int, lane: int, k: int, p0: int, margin: S, top: Topology, sheets: Sheets, cells: Cells
    ):
        count = top.particle_count[k]
        base = top.particle_start[k]
        grid = sheets.grid[k]
        heads = cells.head_start[g] + lane * grid * grid
        links = p0 * wp.static(L) + lane * count
        start = cells.list_start[g] + lane * cells.capacity[g]
        x = get(cells.x, p0, lane)
        low0 = x[0]
        low1 = x[1]
        high0 = x[0]
        high1 = x[1]
        for i in range(count):
            x = get(cells.x, p0 + i, lane)
            put(cells.xr_flat, p0 + i, lane, x)
            low0 = wp.min(low0, x[0])
            low1 = wp.min(low1, x[1])
            high0 = wp.max(high0, x[0])
            high1 = wp.max(high1, x[1])
        side = wp.max(wp.max(high0 - low0, high1 - low1) / S(grid), sheets.cell[k])
        inverse = S(1.0) / side
        for at in range(grid * grid):
            cells.head[heads + at] = -1
        for i in range(count):
            x = get(cells.x, p0 + i, lane)
            row = cell_of(x[0], low0, inverse, grid)
            at = heads + row * grid + cell_of(x[1], low1, inverse, grid)
            cells.next[links + i] = cells.head[at]
            cells.head[at] = i
        listed = int(0)
        left_out = int(0)
        for f in range(sheets.first[k], sheets.first[k + 1]):
            tri = sheets.triangle[f]
            a = get(cells.x, p0 + tri[0], lane)
            b = get(cells.x, p0 + tri[1], lane)
            c = get(cells.x, p0 + tri[2], lane)
            thick = sheets.skin[base + tri[0]]
            wide = thick + sheets.widest[k] + margin
            reach = R3(wide, wide, wide)
            low = wp.min(a, wp.min(b, c)) - reach
            high = wp.max(a, wp.max(b, c)) + reach
            last0 = cell_of(high[0], low0, inverse, grid)
            first1 = cell_of(low[1], low1, inverse, grid)
            last1 = cell_of(high[1], low1, inverse, grid)
            for c0 in range(cell_of(low[0], low0, inverse, grid), last0 + 1):
                for c1 in range(first1, last1 + 1):
                    i = cells.head[heads + c0 * grid + c1]
                    while i >= 0:
                        p = get(cells.x, p0 + i, lane)
                        if (
                            p[2] > low[2] and p[2] < high[2]
                            and p[0] > low[0] and p[0] < high[0]
                            and p[1] > low[1] and p[1] < high[1]
                        ):  # fmt: skip
                            if not excluded(i, tri, base, sheets):
                                u = barycentric(p, a, b, c)
                                d = p - (a * u[0] + b * u[1] + c * u[2])
                                gap = sheets.skin[base + i] + thick
                                if wp.dot(d, d) < (gap + margin) * (gap + margin):
                                    if listed < cells.capacity[g]:
                                        above = wp.dot(wp.cross(b - a, c - a), d) >= S(0.0)
                                        cells.particle[start + listed] = i
                                        cells.face[start + listed] = f
                                        cells.gap[start + listed] = wp.where(above, gap, -gap)
                                        listed += 1
                                    else:
                                        left_out += 1
                        i = cells.next[links + i]
        cells.count[g * wp.static(L) + lane] = listed
        return left_out

    return SimpleNamespace(moved_since=moved_since, list_triangles=list_triangles)
