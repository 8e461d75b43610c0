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
from .table_support import CARRIED, table_support
from .triangle_contact import RIM

__all__ = ["INSIDE", "edge_contact"]

INSIDE = 1.0e-3
"""Nearest points this close to an end (as shares of the edge) are left to vertices and faces."""
PARALLEL = 0.01
"""Squared sine below which two edges have no normal between them."""


@functools.cache
def edge_contact(scalar: Any, lanes: int) -> SimpleNamespace:
    """`project_edges` solves the pairs that `edge_list` lists for one lane, in that order.

    Two edges stay on the sides on which they were listed, and change them when one has come round
    an end of the other.

    `nearest(a, b, c, d)`: shares along a-b and c-d of the nearest points of the two.
    """
    t = structures(scalar, lanes)
    S, R3, L = t.S, t.R3, t.L
    R2 = wp.types.vector(2, S)
    Topology, Sheets, Cells = t.Topology, t.Sheets, t.Cells
    access = lane_access(scalar, lanes)
    get, put, get_mass = access.get, access.put, access.get_mass
    support = table_support(scalar, lanes)
    raised, carried = support.raised, support.carried

    @wp.func
    def nearest(a: R3, b: R3, c: R3, d: R3):
        """Source: Ericson, "Real-Time Collision Detection", 2005, section 5.1.9."""
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
    def project_edge(
        k: int,
        lane: int,
        p0: int,
        radii: int,
        max_recovery: S,
        top: Topology,
        sheets: Sheets,
        cells: Cells,
    ):
        """One pair; returns whether it moved."""
        acts = bool(False)
        e = sheets.edge[cells.edge_a[k]]
        f = sheets.edge[cells.edge_b[k]]
        signed = cells.edge_gap[k]
        xa = get(cells.x, p0 + e[0], lane)
        xb = get(cells.x, p0 + e[1], lane)
        xc = get(cells.x, p0 + f[0], lane)
        xd = get(cells.x, p0 + f[1], lane)
        a = raised(xa, top.radius[radii + e[0]])
        b = raised(xb, top.radius[radii + e[1]])
        c = raised(xc, top.radius[radii + f[0]])
        d = raised(xd, top.radius[radii + f[1]])
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
                borne = carried(n[2], a, xa, wa * (S(1.0) - u)) + carried(n[2], b, xb, wb * u)
                borne += carried(-n[2], c, xc, wc * (S(1.0) - v)) + carried(-n[2], d, xd, wd * v)
                w -= S(CARRIED) * n[2] * n[2] * borne
                moved = (a - get(cells.xp, p0 + e[0], lane)) * (S(1.0) - u)
                moved += (b - get(cells.xp, p0 + e[1], lane)) * u
                moved -= (c - get(cells.xp, p0 + f[0], lane)) * (S(1.0) - v)
                moved -= (d - get(cells.xp, p0 + f[1], lane)) * v
                gap = wp.dot(a + (b - a) * u - c - (d - c) * v, n)
                depth = wp.min(h - gap, wp.max(max_recovery - wp.dot(moved, n), S(0.0)))
                if depth > S(0.0) and w > S(0.0):
                    step = n * (depth / w)
                    put(cells.x, p0 + e[0], lane, xa + step * wa)
                    put(cells.x, p0 + e[1], lane, xb + step * wb)
                    put(cells.x, p0 + f[0], lane, xc - step * wc)
                    put(cells.x, p0 + f[1], lane, xd - step * wd)
                    acts = True
            elif apart < S(0.0):
                if wp.length_sq(a + (b - a) * u - c - (d - c) * v) > S(RIM * RIM) * h * h:
                    cells.edge_gap[k] = -signed
        return acts

    @wp.func
    def project_edges(
        g: int,
        lane: int,
        p0: int,
        radii: int,
        max_recovery: S,
        top: Topology,
        sheets: Sheets,
        cells: Cells,
    ):
        start = cells.list_start[g] + lane * cells.capacity[g]
        for k in range(start, start + cells.edge_count[g * wp.static(L) + lane]):
            project_edge(k, lane, p0, radii, max_recovery, top, sheets, cells)

    return SimpleNamespace(project_edges=project_edges, project_edge=project_edge, nearest=nearest)
