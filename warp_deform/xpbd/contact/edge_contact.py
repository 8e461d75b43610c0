"""Contact between edges of triangles, where fabrics cross without a vertex near a face.

Source: Bridson, Fedkiw, Anderson, "Robust Treatment of Collisions, Contact and Friction for Cloth
Animation", 2002. Frictionless: faces carry the friction.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..lanes.lane_access import lane_access
from ..lanes.structures import structures
from .cell_sort import RUN, cell_sort

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

    `list_edges` follows `list_triangles` (see `cell_list`), whose slacks and moved particles it
    takes over, and returns how many pairs found no room.
    """
    t = structures(scalar, lanes)
    S, R3, L = t.S, t.R3, t.L
    R2, V4 = wp.types.vector(2, S), t.V4
    cells_ = cell_sort(scalar, lanes)
    cell_of, sort_cells = cells_.cell_of, cells_.sort_cells
    hits_in_ball, first_hit = cells_.hits_in_ball, cells_.first_hit
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
        along_ab = S(0.0)
        if rest > S(1.0e-6) * uu * vv:
            along_ab = wp.clamp((uv * vr - ur * vv) / rest, S(0.0), S(1.0))
        along_cd = (uv * along_ab + vr) / vv
        if along_cd < S(0.0):
            along_cd = S(0.0)
            along_ab = wp.clamp(-ur / uu, S(0.0), S(1.0))
        elif along_cd > S(1.0):
            along_cd = S(1.0)
            along_ab = wp.clamp((uv - ur) / uu, S(0.0), S(1.0))
        return R2(along_ab, along_cd)

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
    def xyz(p: V4):
        return R3(p[0], p[1], p[2])

    @wp.func
    def meeting(base: int, places: int, e: wp.vec2i, f: wp.vec2i, sheets: Sheets, cells: Cells):
        """Signed distance at which two edges touch, 0 where they are too far apart to be listed."""
        gap = S(0.0)
        if e[0] != f[0] and e[0] != f[1] and e[1] != f[0] and e[1] != f[1]:
            a4 = cells.place[places + e[0]]
            b4 = cells.place[places + e[1]]
            c4 = cells.place[places + f[0]]
            d4 = cells.place[places + f[1]]
            a = xyz(a4)
            b = xyz(b4)
            c = xyz(c4)
            d = xyz(d4)
            h = S(0.5) * (sheets.edge_gap[base + e[0]] + sheets.edge_gap[base + f[0]])
            far = h + wp.max(a4[3], b4[3]) + wp.max(c4[3], d4[3])
            # most are apart along the line between their middles, which is cheap to see
            way = a + b - c - d
            w2 = wp.length_sq(way)
            apart = w2 - wp.abs(wp.dot(b - a, way)) - wp.abs(wp.dot(d - c, way))
            if apart < S(0.0) or apart * apart < S(4.0) * far * far * w2:
                at = nearest(a, b, c, d)
                way = a + (b - a) * at[0] - c - (d - c) * at[1]
                if wp.length_sq(way) < far * far:
                    h = touching_distance(base, e, f, h, sheets)
                    if h > S(1.0e-5):
                        gap = wp.where(wp.dot(wp.cross(b - a, d - c), way) >= S(0.0), h, -h)
        return gap

    @wp.func
    def drop_moved(start: int, count: int, links: int, sheets: Sheets, cells: Cells):
        """Takes pairs with a moved end off the list; returns how many are left."""
        remaining = int(0)
        for at in range(start, start + count):
            e = sheets.edge[cells.edge_a[at]]
            f = sheets.edge[cells.edge_b[at]]
            if (
                cells.moved[links + e[0]]
                + cells.moved[links + e[1]]
                + cells.moved[links + f[0]]
                + cells.moved[links + f[1]]
            ) == 0:
                cells.edge_a[start + remaining] = cells.edge_a[at]
                cells.edge_b[start + remaining] = cells.edge_b[at]
                cells.edge_gap[start + remaining] = cells.edge_gap[at]
                remaining += 1
        return remaining

    @wp.func
    def list_edges(
        g: int, lane: int, k: int, p0: int, anew: bool, top: Topology, sheets: Sheets, cells: Cells
    ):
        base = top.particle_start[k]
        first = sheets.edge_first[k]
        count = sheets.edge_first[k + 1] - first
        grid = sheets.grid[k]
        heads = cells.head_start[g] + lane * (grid * grid + 1)
        links = cells.link_start[g] + lane * count
        places = p0 * wp.static(L) + lane * top.particle_count[k]
        start = cells.list_start[g] + lane * cells.capacity[g]
        slot = g * wp.static(L) + lane
        listed = int(0)
        if not anew:
            listed = drop_moved(start, cells.edge_count[slot], places, sheets, cells)
        # the cells cover what moved edges can reach
        half = S(0.0)
        low = R3(S(1.0e9), S(1.0e9), S(1.0e9))
        high = -low
        for n in range(count):
            e = sheets.edge[first + n]
            moved = cells.moved[places + e[0]] + cells.moved[places + e[1]]
            cells.edge_moved[links + n] = moved
            ball = cells.edge_ball[links + n]
            if moved > 0:
                a4 = cells.place[places + e[0]]
                b4 = cells.place[places + e[1]]
                middle = (xyz(a4) + xyz(b4)) * S(0.5)
                l = S(0.5) * wp.length(xyz(b4) - xyz(a4))
                # what a slack adds to the reach of the edge makes its ball larger
                ball = V4(middle[0], middle[1], middle[2], l + wp.max(a4[3], b4[3]))
                cells.edge_ball[links + n] = ball
                low = wp.min(low, middle)
                high = wp.max(high, middle)
            half = wp.max(half, ball[3])
        wide = S(2.0) * half + sheets.edge_widest[k]
        low = low - R3(wide, wide, wide)
        high = high + R3(wide, wide, wide)
        low0 = low[0]
        low1 = low[1]
        inverse = S(grid) / wp.max(wp.max(high[0] - low0, high[1] - low1), S(grid) * sheets.cell[k])
        sort_cells(
            heads,
            grid,
            links,
            count,
            low,
            high,
            inverse,
            cells.edge_ball,
            cells.edge_moved,
            cells.head,
            cells.edge_key,
            cells.edge_sorted,
        )
        left_out = int(0)
        for n in range(count):
            if cells.edge_moved[links + n] > 0:
                e = sheets.edge[first + n]
                ball = cells.edge_ball[links + n]
                ball[3] = ball[3] + sheets.edge_widest[k]
                wide = ball[3] + half
                first1 = heads + cell_of(ball[1] - wide, low1, inverse, grid)
                last1 = heads + cell_of(ball[1] + wide, low1, inverse, grid) + 1
                last0 = cell_of(ball[0] + wide, low0, inverse, grid)
                for row in range(cell_of(ball[0] - wide, low0, inverse, grid), last0 + 1):
                    end = links + cells.head[last1 + row * grid]
                    at = links + cells.head[first1 + row * grid]
                    while at < end:
                        # two moved ones meet once
                        hits = hits_in_ball(cells.edge_sorted, cells.edge_key, at, end, ball, n)
                        while hits != 0:
                            m = cells.edge_key[at + first_hit(hits)]
                            hits = hits & (hits - 1)
                            if m < 0:
                                m = -1 - m
                            gap = meeting(base, places, e, sheets.edge[first + m], sheets, cells)
                            if gap != S(0.0):
                                if listed < cells.capacity[g]:
                                    cells.edge_a[start + listed] = first + n
                                    cells.edge_b[start + listed] = first + m
                                    cells.edge_gap[start + listed] = gap
                                    listed += 1
                                else:
                                    left_out += 1
                        at += wp.static(RUN)
        cells.edge_count[slot] = listed
        return left_out

    @wp.func
    def project_edge(k: int, lane: int, p0: int, max_recovery: S, sheets: Sheets, cells: Cells):
        """One pair; returns whether it moved."""
        acts = bool(False)
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
                depth = wp.min(h - gap, wp.max(max_recovery - wp.dot(moved, n), S(0.0)))
                if depth > S(0.0) and w > S(0.0):
                    step = n * (depth / w)
                    put(cells.x, p0 + e[0], lane, a + step * wa)
                    put(cells.x, p0 + e[1], lane, b + step * wb)
                    put(cells.x, p0 + f[0], lane, c - step * wc)
                    put(cells.x, p0 + f[1], lane, d - step * wd)
                    acts = True
        return acts

    @wp.func
    def project_edges(g: int, lane: int, p0: int, max_recovery: S, sheets: Sheets, cells: Cells):
        start = cells.list_start[g] + lane * cells.capacity[g]
        for k in range(start, start + cells.edge_count[g * wp.static(L) + lane]):
            project_edge(k, lane, p0, max_recovery, sheets, cells)

    return SimpleNamespace(
        list_edges=list_edges,
        project_edges=project_edges,
        project_edge=project_edge,
        nearest=nearest,
    )
