"""Contact between edges of triangles, where fabrics cross without a vertex near a face.

Source: Bridson, Fedkiw, Anderson, "Robust Treatment of Collisions, Contact and Friction for Cloth
Animation", 2002. Frictionless: faces carry the friction.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from .lane_access import lane_access
from .structures import structures

__all__ = ["edge_contact"]

REST_SHARE = 0.7
"""Edges of one fabric touch at this share of their distance in the rest shape at most."""
INSIDE = 1.0e-3
"""Nearest points this close to an end (as shares of the edge) are left to vertices and faces."""
PARALLEL = 0.01
"""Squared sine below which two edges have no normal between them."""


@functools.cache
def edge_contact(scalar: Any, lanes: int) -> SimpleNamespace:
    """`list_edges` lists pairs of edges of one lane, `project_edges` solves them in that order.

    Listing uses the cells of the lane's triangles, which must have been listed just before, and
    returns how many pairs found no room.
    """
    t = structures(scalar, lanes)
    S, R3, L = t.S, t.R3, t.L
    R2 = wp.types.vector(2, S)
    Topology, Sheets, Cells = t.Topology, t.Sheets, t.Cells
    access = lane_access(scalar, lanes)
    get, put, get_mass = access.get, access.put, access.get_mass

    @wp.func
    def nearest(a: R3, b: R3, c: R3, d: R3):
        """Shares along a-b and c-d of the nearest points of the two (Ericson, 2005, 5.1.9)."""
        u = b - a
        v = d - c
        r = a - c
        uu = wp.dot(u, u) + S(1.0e-14)
        vv = wp.dot(v, v) + S(1.0e-14)
        uv = wp.dot(u, v)
        ur = wp.dot(u, r)
        vr = wp.dot(v, r)
        rest = uu * vv - uv * uv
        s = S(0.0)
        if rest > S(1.0e-6) * uu * vv:
            s = wp.clamp((uv * vr - ur * vv) / rest, S(0.0), S(1.0))
        q = (uv * s + vr) / vv
        if q < S(0.0):
            q = S(0.0)
            s = wp.clamp(-ur / uu, S(0.0), S(1.0))
        elif q > S(1.0):
            q = S(1.0)
            s = wp.clamp((uv - ur) / uu, S(0.0), S(1.0))
        return R2(s, q)

    @wp.func
    def touching_distance(base: int, e: wp.vec2i, f: wp.vec2i, thick: S, sheets: Sheets):
        """At which distance two edges touch: less where they are close in the rest shape."""
        h = thick
        if sheets.owner[base + e[0]] == sheets.owner[base + f[0]]:
            a = sheets.rest[base + e[0]]
            b = sheets.rest[base + e[1]]
            c = sheets.rest[base + f[0]]
            d = sheets.rest[base + f[1]]
            at = nearest(a, b, c, d)
            apart = wp.length(a + (b - a) * at[0] - c - (d - c) * at[1])
            h = wp.min(thick, apart * S(REST_SHARE))
        return h

    @wp.func
    def list_edges(
        g: int, lane: int, k: int, p0: int, margin: S, top: Topology, sheets: Sheets, cells: Cells
    ):
        base = top.particle_start[k]
        first = sheets.edge_first[k]
        count = sheets.edge_first[k + 1] - first
        grid = sheets.grid[k]
        heads = cells.head_start[g] + lane * grid * grid
        links = cells.link_start[g] + lane * count
        start = cells.list_start[g] + lane * cells.capacity[g]
        # one square around all midpoints
        half = S(0.0)
        a = get(cells.x, p0, lane)
        low0 = a[0]
        low1 = a[1]
        high0 = a[0]
        high1 = a[1]
        for n in range(count):
            ij = sheets.edge[first + n]
            a = get(cells.x, p0 + ij[0], lane)
            b = get(cells.x, p0 + ij[1], lane)
            half = wp.max(half, wp.length_sq(b - a))
            low0 = wp.min(low0, a[0])
            low1 = wp.min(low1, a[1])
            high0 = wp.max(high0, a[0])
            high1 = wp.max(high1, a[1])
        half = S(0.5) * wp.sqrt(half)
        side = wp.max(wp.max(high0 - low0, high1 - low1) / S(grid), sheets.cell[k])
        inverse = S(1.0) / side
        for at in range(grid * grid):
            cells.head[heads + at] = -1
        listed = int(0)
        left_out = int(0)
        for n in range(count):
            e = sheets.edge[first + n]
            a = get(cells.x, p0 + e[0], lane)
            b = get(cells.x, p0 + e[1], lane)
            thick = sheets.edge_gap[base + e[0]]
            wide = thick + margin
            reach = R3(wide, wide, wide)
            low = wp.min(a, b) - reach
            high = wp.max(a, b) + reach
            r0 = wp.clamp(int((low[0] - half - low0) * inverse), 0, grid - 1)
            r1 = wp.clamp(int((high[0] + half - low0) * inverse), 0, grid - 1)
            q0 = wp.clamp(int((low[1] - half - low1) * inverse), 0, grid - 1)
            q1 = wp.clamp(int((high[1] + half - low1) * inverse), 0, grid - 1)
            for r in range(r0, r1 + 1):
                for q in range(q0, q1 + 1):
                    m = cells.head[heads + r * grid + q]
                    while m >= 0:
                        f = sheets.edge[first + m]
                        c = get(cells.x, p0 + f[0], lane)
                        d = get(cells.x, p0 + f[1], lane)
                        l = wp.min(c, d)
                        h = wp.max(c, d)
                        if (
                            l[2] < high[2] and h[2] > low[2]
                            and l[0] < high[0] and h[0] > low[0]
                            and l[1] < high[1] and h[1] > low[1]
                            and e[0] != f[0] and e[0] != f[1] and e[1] != f[0] and e[1] != f[1]
                        ):  # fmt: skip
                            at2 = nearest(a, b, c, d)
                            way = a + (b - a) * at2[0] - c - (d - c) * at2[1]
                            if wp.length_sq(way) < wide * wide:
                                gap = touching_distance(base, e, f, thick, sheets)
                                if gap > S(1.0e-5):
                                    if listed < cells.capacity[g]:
                                        above = wp.dot(wp.cross(b - a, d - c), way) >= S(0.0)
                                        cells.edge_a[start + listed] = first + n
                                        cells.edge_b[start + listed] = first + m
                                        cells.edge_gap[start + listed] = wp.where(above, gap, -gap)
                                        listed += 1
                                    else:
                                        left_out += 1
                        m = cells.edge_next[links + m]
            middle = (a + b) * S(0.5)
            row = wp.clamp(int((middle[0] - low0) * inverse), 0, grid - 1)
            column = wp.clamp(int((middle[1] - low1) * inverse), 0, grid - 1)
            cells.edge_next[links + n] = cells.head[heads + row * grid + column]
            cells.head[heads + row * grid + column] = n
        cells.edge_count[g * wp.static(L) + lane] = listed
        return left_out

    @wp.func
    def project_edges(g: int, lane: int, p0: int, push: S, sheets: Sheets, cells: Cells):
        start = cells.list_start[g] + lane * cells.capacity[g]
        for k in range(start, start + cells.edge_count[g * wp.static(L) + lane]):
            e = sheets.edge[cells.edge_a[k]]
            f = sheets.edge[cells.edge_b[k]]
            signed = cells.edge_gap[k]
            a = get(cells.x, p0 + e[0], lane)
            b = get(cells.x, p0 + e[1], lane)
            c = get(cells.x, p0 + f[0], lane)
            d = get(cells.x, p0 + f[1], lane)
            n = wp.cross(b - a, d - c) * wp.sign(signed)
            n2 = wp.dot(n, n)
            h = wp.abs(signed)
            # distance of the two lines along the normal between them
            apart = wp.dot(a - c, n)
            if (apart <= S(0.0) or apart * apart < h * h * n2) and n2 > (
                S(PARALLEL) * wp.length_sq(b - a) * wp.length_sq(d - c)
            ):
                at = nearest(a, b, c, d)
                u = at[0]
                v = at[1]
                low = S(INSIDE)
                high = S(1.0) - low
                if u > low and u < high and v > low and v < high:
                    n = n / wp.sqrt(n2)
                    wa = get_mass(cells.w, p0 + e[0], lane) * (S(1.0) - u)
                    wb = get_mass(cells.w, p0 + e[1], lane) * u
                    wc = get_mass(cells.w, p0 + f[0], lane) * (S(1.0) - v)
                    wd = get_mass(cells.w, p0 + f[1], lane) * v
                    w = wa * (S(1.0) - u) + wb * u + wc * (S(1.0) - v) + wd * v
                    moved = (a - get(cells.xp, p0 + e[0], lane)) * (S(1.0) - u)
                    moved += (b - get(cells.xp, p0 + e[1], lane)) * u
                    moved -= (c - get(cells.xp, p0 + f[0], lane)) * (S(1.0) - v)
                    moved -= (d - get(cells.xp, p0 + f[1], lane)) * v
                    gap = wp.dot(a + (b - a) * u - c - (d - c) * v, n)
                    depth = wp.min(h - gap, wp.max(push - wp.dot(moved, n), S(0.0)))
                    if depth > S(0.0) and w > S(0.0):
                        step = n * (depth / w)
                        put(cells.x, p0 + e[0], lane, a + step * wa)
                        put(cells.x, p0 + e[1], lane, b + step * wb)
                        put(cells.x, p0 + f[0], lane, c - step * wc)
                        put(cells.x, p0 + f[1], lane, d - step * wd)

    return SimpleNamespace(list_edges=list_edges, project_edges=project_edges)
