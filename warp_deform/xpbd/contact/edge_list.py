"""Which edges of triangles may touch which soon: a list with slack, see `cell_list`."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..lanes.structures import structures
from .cell_list import FLAT
from .cell_sort import RUN, cell_sort
from .edge_contact import INSIDE, edge_contact
from .triangle_contact import RIM

__all__ = ["edge_list"]

REST_SHARE = 0.7
"""Edges of one fabric touch at this share of their distance in the rest shape at most."""
RECALL = 4.0
"""Edges that have gone through each other are led back up to so many times the distance at which
they touch."""


@functools.cache
def edge_list(scalar: Any, lanes: int) -> SimpleNamespace:
    """`list_edges` lists pairs of edges of one lane, and returns how many found no room.

    It follows `list_triangles` (see `cell_list`), whose slacks and moved particles it takes over.
    A pair that has crossed, or nearly, keeps its sides when it is listed anew, so that its contact
    leads it back.
    """
    t = structures(scalar, lanes)
    S, R3, L, V4 = t.S, t.R3, t.L, t.V4
    cells_ = cell_sort(scalar, lanes)
    cell_of, sort_cells = cells_.cell_of, cells_.sort_cells
    hits_in_ball, first_hit = cells_.hits_in_ball, cells_.first_hit
    Topology, Sheets, Cells = t.Topology, t.Sheets, t.Cells
    nearest = edge_contact(scalar, lanes).nearest

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
    def moved_ends(at: int, links: int, sheets: Sheets, cells: Cells):
        e = sheets.edge[cells.edge_a[at]]
        f = sheets.edge[cells.edge_b[at]]
        return (
            cells.moved[links + e[0]]
            + cells.moved[links + e[1]]
            + cells.moved[links + f[0]]
            + cells.moved[links + f[1]]
        )

    @wp.func
    def pressed(at: int, links: int, sheets: Sheets, cells: Cells):
        """Whether two listed edges have gone through each other, or nearly, and not too far."""
        e = sheets.edge[cells.edge_a[at]]
        f = sheets.edge[cells.edge_b[at]]
        a = xyz(cells.place[links + e[0]])
        b = xyz(cells.place[links + e[1]])
        c = xyz(cells.place[links + f[0]])
        d = xyz(cells.place[links + f[1]])
        gap = cells.edge_gap[at]
        result = bool(False)
        m = wp.cross(b - a, d - c)
        above = wp.dot(a - c, m) * wp.sign(gap)
        flat = S(FLAT) * wp.abs(gap) * wp.length(m)
        if above < flat:
            at_both = nearest(a, b, c, d)
            u = at_both[0]
            v = at_both[1]
            apart2 = wp.length_sq(a + (b - a) * u - c - (d - c) * v) / (gap * gap)
            low = S(INSIDE)
            high = S(1.0) - low
            if u > low and u < high and v > low and v < high:
                result = apart2 < S(RECALL * RECALL)
            else:
                result = above > -flat and apart2 < S(RIM * RIM)
        return result

    @wp.func
    def keep_pressed(start: int, count: int, links: int, sheets: Sheets, cells: Cells):
        """Brings pressed pairs with a moved end to the front; returns how many they are."""
        kept = int(0)
        for at in range(start, start + count):
            if moved_ends(at, links, sheets, cells) > 0:
                if pressed(at, links, sheets, cells):
                    to = start + kept
                    first = cells.edge_a[at]
                    second = cells.edge_b[at]
                    gap = cells.edge_gap[at]
                    cells.edge_a[at] = cells.edge_a[to]
                    cells.edge_b[at] = cells.edge_b[to]
                    cells.edge_gap[at] = cells.edge_gap[to]
                    cells.edge_a[to] = first
                    cells.edge_b[to] = second
                    cells.edge_gap[to] = gap
                    kept += 1
        return kept

    @wp.func
    def is_kept(start: int, kept: int, n: int, m: int, cells: Cells):
        result = bool(False)
        for at in range(start, start + kept):
            a = cells.edge_a[at]
            b = cells.edge_b[at]
            result = result or (a == n and b == m) or (a == m and b == n)
        return result

    @wp.func
    def drop_moved(start: int, kept: int, count: int, links: int, sheets: Sheets, cells: Cells):
        """Takes pairs with a moved end off the list behind `kept`; returns how many are left."""
        remaining = int(kept)
        for at in range(start + kept, start + count):
            if moved_ends(at, links, sheets, cells) == 0:
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
        kept = int(0)
        if not anew:
            kept = keep_pressed(start, cells.edge_count[slot], places, sheets, cells)
            listed = drop_moved(start, kept, cells.edge_count[slot], places, sheets, cells)
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
                            if gap != S(0.0) and not is_kept(
                                start, kept, first + n, first + m, cells
                            ):
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

    return SimpleNamespace(list_edges=list_edges)
