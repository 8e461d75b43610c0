"""Which particles may touch which triangles soon: a list with slack, one world at a time.

A pair is listed that is nearer than touching distance + the slacks of its two sides, so it cannot
come to touch unlisted before a particle has used up its slack (Verlet, 1967). Then the pairs of
what has moved are listed anew, and only those: most of a sheet lies still while a part is carried.
What moves gets more slack than what lies, so the list of a sheet at rest is short. What has been
pressed into a triangle's plane, or through it, keeps its side when the two are listed anew, so that
their contact leads it back. The list and its order follow from the world's own past only.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..lanes.algebra import add, any_less, dot, mul, sub  # noqa: F401  (operators are found by name)
from ..lanes.lane_access import lane_access
from ..lanes.structures import structures
from .cell_sort import RUN, cell_sort
from .closest_point import closest_point
from .triangle_contact import RIM

__all__ = ["FLAT", "cell_list"]

MOST = 0.2
"""Largest slack of a particle, as a share of a fabric's cell: more would list its neighbours."""
LEAST = 0.3
"""Least slack of a particle, as a share of the largest."""
STEPS = 16.0
"""Substeps at its present speed for which a particle's slack lasts, between these limits."""
FLAT = 0.25
"""What is nearer to a plane than this share of the distance at which they touch may be on either
side of it by chance."""
SOON = 0.4
"""Share of its slack after which a particle's pairs are listed anew, if others have to be."""


@functools.cache
def cell_list(scalar: Any, lanes: int) -> SimpleNamespace:
    """`common_step(p0, n, dt, particles)`, `moved_since(p0, n, drift, particles, cells)`
    and `list_triangles(...)`.

    `common_step` is what all particles do in this substep, along each axis the step of the slowest,
    or 0 where they do not go the same way. Summed up it is the `drift`, with which the frame of the
    lists goes along: a sheet that falls or is carried as a whole keeps its list.
    `moved_since` is positive for lanes in which a particle has used up its slack in that frame.
    `list_triangles` brings the list of one lane up to date, or makes it `anew`, and returns how
    many pairs found no room in it.
    """
    t = structures(scalar, lanes)
    S, V, V3, R3, L = t.S, t.V, t.V3, t.R3, t.L
    M33, V4 = t.M33, t.V4
    cells_ = cell_sort(scalar, lanes)
    cell_of, sort_cells = cells_.cell_of, cells_.sort_cells
    hits_in_box, first_hit = cells_.hits_in_box, cells_.first_hit
    Topology, Sheets, Cells, Particles = t.Topology, t.Sheets, t.Cells, t.Particles
    access = lane_access(scalar, lanes)
    get, put, get_mass, put_scalar = access.get, access.put, access.get_mass, access.put_scalar
    barycentric = closest_point(scalar, lanes).barycentric

    @wp.func
    def common_step(p0: int, n: int, dt: S, particles: Particles):
        low = particles.v[p0]
        high = low
        zero = V(S(0.0))
        i = p0 + 1
        alike = bool(True)
        while alike and i < p0 + n:
            v = particles.v[i]
            low = V3(wp.min(low.x, v.x), wp.min(low.y, v.y), wp.min(low.z, v.z))
            high = V3(wp.max(high.x, v.x), wp.max(high.y, v.y), wp.max(high.z, v.z))
            apart = wp.max(wp.max(low.x, zero - high.x), wp.max(low.y, zero - high.y))
            alike = any_less(zero - wp.max(apart, wp.max(low.z, zero - high.z)), S(0.0))
            i += 1
        return (
            V3(
                wp.max(low.x, wp.min(high.x, zero)),
                wp.max(low.y, wp.min(high.y, zero)),
                wp.max(low.z, wp.min(high.z, zero)),
            )
            * dt
        )

    @wp.func
    def moved_since(p0: int, n: int, drift: V3, particles: Particles, cells: Cells):
        worst = V(S(0.0))
        for i in range(p0, p0 + n):
            d = particles.x[i] - drift - cells.xr[i]
            slack = cells.slack[i]
            worst = wp.max(worst, dot(d, d) - mul(slack, slack))
        return worst

    @wp.func
    def xyz(p: V4):
        return R3(p[0], p[1], p[2])

    @wp.func
    def follow(
        lane: int,
        p0: int,
        count: int,
        links: int,
        most: S,
        anew: bool,
        drift: R3,
        common: R3,
        cells: Cells,
    ):
        """Moves the references of particles that have gone far, and renews their slack.

        That is `most` [m] at most. Returns the lower and the upper corner of the box around those,
        and the largest slack of all.
        """
        low = R3(S(1.0e9), S(1.0e9), S(1.0e9))
        high = -low
        loosest = S(0.0)
        for i in range(count):
            now = get(cells.x, p0 + i, lane)
            x = now - drift
            d = x - xyz(cells.place[links + i])
            slack = get_mass(cells.slack_flat, p0 + i, lane)
            moved = int(0)
            # those that would have to follow soon come along
            if anew or wp.dot(d, d) > S(SOON * SOON) * slack * slack:
                moved = 1
                step = wp.length(now - get(cells.xp, p0 + i, lane) - common)
                slack = wp.clamp(S(STEPS) * step, S(LEAST) * most, most)
                put_scalar(cells.slack_flat, p0 + i, lane, slack)
                put(cells.xr_flat, p0 + i, lane, x)
                cells.place[links + i] = V4(x[0], x[1], x[2], slack)
                low = wp.min(low, x)
                high = wp.max(high, x)
            cells.moved[links + i] = moved
            loosest = wp.max(loosest, slack)
        return M33(low[0], low[1], low[2], high[0], high[1], high[2], loosest, S(0.0), S(0.0))

    @wp.func
    def moved_corners(links: int, tri: wp.vec3i, cells: Cells):
        return (
            cells.moved[links + tri[0]] + cells.moved[links + tri[1]] + cells.moved[links + tri[2]]
        )

    @wp.func
    def pressed(at: int, links: int, sheets: Sheets, cells: Cells):
        """Whether a listed particle has gone through its triangle, or nearly: its place no longer
        tells on which side it belongs.
        """
        tri = sheets.triangle[cells.face[at]]
        p = xyz(cells.place[links + cells.particle[at]])
        a = xyz(cells.place[links + tri[0]])
        b = xyz(cells.place[links + tri[1]])
        c = xyz(cells.place[links + tri[2]])
        gap = cells.gap[at]
        result = bool(False)
        m = wp.cross(b - a, c - a)
        above = wp.dot(p - a, m) * wp.sign(gap)
        flat = S(FLAT) * wp.abs(gap) * wp.length(m)
        if above < flat:
            u = barycentric(p, a, b, c)
            d = p - (a * u[0] + b * u[1] + c * u[2])
            if wp.min(u[0], wp.min(u[1], u[2])) > S(0.0):
                result = wp.length_sq(d) < gap * gap
            else:
                result = above > -flat and wp.length_sq(d) < S(RIM * RIM) * gap * gap
        return result

    @wp.func
    def keep_pressed(start: int, count: int, links: int, sheets: Sheets, cells: Cells):
        """Brings pressed pairs with a moved particle to the front; returns how many they are."""
        kept = int(0)
        for at in range(start, start + count):
            i = cells.particle[at]
            f = cells.face[at]
            if cells.moved[links + i] + moved_corners(links, sheets.triangle[f], cells) > 0:
                if pressed(at, links, sheets, cells):
                    to = start + kept
                    gap = cells.gap[at]
                    cells.particle[at] = cells.particle[to]
                    cells.face[at] = cells.face[to]
                    cells.gap[at] = cells.gap[to]
                    cells.particle[to] = i
                    cells.face[to] = f
                    cells.gap[to] = gap
                    kept += 1
        return kept

    @wp.func
    def is_kept(start: int, kept: int, i: int, f: int, cells: Cells):
        result = bool(False)
        for at in range(start, start + kept):
            result = result or (cells.particle[at] == i and cells.face[at] == f)
        return result

    @wp.func
    def drop_moved(start: int, kept: int, count: int, links: int, sheets: Sheets, cells: Cells):
        """Takes pairs with a moved particle off the list behind `kept`; returns what is left."""
        remaining = int(kept)
        for at in range(start + kept, start + count):
            i = cells.particle[at]
            f = cells.face[at]
            tri = sheets.triangle[f]
            if cells.moved[links + i] + moved_corners(links, tri, cells) == 0:
                cells.particle[start + remaining] = i
                cells.face[start + remaining] = f
                cells.gap[start + remaining] = cells.gap[at]
                remaining += 1
        return remaining

    @wp.func
    def exempt(f: int, tri: wp.vec3i, base: int, links: int, sheets: Sheets, cells: Cells):
        """Stamps the particles that are too close to the triangle in the rest shape to touch it."""
        for corner in range(3):
            j = base + tri[corner]
            for at in range(sheets.exempt_first[j], sheets.exempt_first[j + 1]):
                cells.stamp[links + sheets.exempt[at]] = f + 1

    @wp.func
    def list_triangles(
        g: int,
        lane: int,
        k: int,
        p0: int,
        margin: S,
        anew: bool,
        drift: V3,
        common: V3,
        top: Topology,
        sheets: Sheets,
        cells: Cells,
    ):
        count = top.particle_count[k]
        base = top.particle_start[k]
        grid = sheets.grid[k]
        heads = cells.head_start[g] + lane * (grid * grid + 1)
        links = p0 * wp.static(L) + lane * count
        start = cells.list_start[g] + lane * cells.capacity[g]
        slot = g * wp.static(L) + lane
        most = wp.min(margin, S(MOST) * sheets.cell[k])
        gone = R3(drift.x[lane], drift.y[lane], drift.z[lane])
        going = R3(common.x[lane], common.y[lane], common.z[lane])
        box = follow(lane, p0, count, links, most, anew, gone, going, cells)
        near = R3(box[0, 0], box[0, 1], box[0, 2])  # box around the moved particles
        far = R3(box[1, 0], box[1, 1], box[1, 2])
        loosest = box[2, 0]
        listed = int(0)
        kept = int(0)
        if not anew:
            kept = keep_pressed(start, cells.count[slot], links, sheets, cells)
            listed = drop_moved(start, kept, cells.count[slot], links, sheets, cells)
        # the cells cover what triangles with a moved corner can reach
        low = near
        high = far
        for f in range(sheets.first[k], sheets.first[k + 1]):
            tri = sheets.triangle[f]
            if moved_corners(links, tri, cells) > 0:
                for corner in range(3):
                    x = xyz(cells.place[links + tri[corner]])
                    low = wp.min(low, x)
                    high = wp.max(high, x)
        wide = S(2.0) * (sheets.widest[k] + loosest)
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
            cells.place,
            cells.moved,
            cells.head,
            cells.key,
            cells.sorted,
        )
        left_out = int(0)
        for f in range(sheets.first[k], sheets.first[k + 1]):
            tri = sheets.triangle[f]
            a4 = cells.place[links + tri[0]]
            b4 = cells.place[links + tri[1]]
            c4 = cells.place[links + tri[2]]
            a = xyz(a4)
            b = xyz(b4)
            c = xyz(c4)
            slack = wp.max(a4[3], wp.max(b4[3], c4[3]))
            thick = sheets.skin[base + tri[0]]
            wide = thick + sheets.widest[k] + slack + loosest
            low = wp.min(a, wp.min(b, c)) - R3(wide, wide, wide)
            high = wp.max(a, wp.max(b, c)) + R3(wide, wide, wide)
            m = wp.cross(b - a, c - a)
            m2 = wp.length_sq(m)
            moved = moved_corners(links, tri, cells)
            if moved > 0 or (
                low[2] < far[2]
                and high[2] > near[2]
                and low[0] < far[0]
                and high[0] > near[0]
                and low[1] < far[1]
                and high[1] > near[1]
            ):
                # what has not moved either is listed with an unmoved triangle already
                least = wp.where(moved > 0, -count, 0)
                stamped = bool(False)
                first1 = heads + cell_of(low[1], low1, inverse, grid)
                last1 = heads + cell_of(high[1], low1, inverse, grid) + 1
                last0 = cell_of(high[0], low0, inverse, grid)
                for row in range(cell_of(low[0], low0, inverse, grid), last0 + 1):
                    end = links + cells.head[last1 + row * grid]
                    at = links + cells.head[first1 + row * grid]
                    while at < end:
                        hits = hits_in_box(cells.sorted, cells.key, at, end, low, high, least)
                        if hits != 0 and not stamped:
                            exempt(f, tri, base, links, sheets, cells)
                            stamped = True
                        while hits != 0:
                            hit = at + first_hit(hits)
                            hits = hits & (hits - 1)
                            i = cells.key[hit]
                            if i < 0:
                                i = -1 - i
                            if cells.stamp[links + i] != f + 1 and not is_kept(
                                start, kept, i, f, cells
                            ):
                                p4 = cells.sorted[hit]
                                p = xyz(p4)
                                gap = sheets.skin[base + i] + thick
                                reach = gap + slack + p4[3]
                                # distance from the plane, before anything dear
                                off = wp.dot(m, p - a)
                                if off * off < reach * reach * m2:
                                    u = barycentric(p, a, b, c)
                                    d = p - (a * u[0] + b * u[1] + c * u[2])
                                    if wp.dot(d, d) < reach * reach:
                                        if listed < cells.capacity[g]:
                                            above = wp.dot(m, d) >= S(0.0)
                                            cells.particle[start + listed] = i
                                            cells.face[start + listed] = f
                                            cells.gap[start + listed] = wp.where(above, gap, -gap)
                                            listed += 1
                                        else:
                                            left_out += 1
                        at += wp.static(RUN)
        cells.count[slot] = listed
        return left_out

    return SimpleNamespace(
        common_step=common_step, moved_since=moved_since, list_triangles=list_triangles
    )
