"""Contact and friction between particles and triangles: fabric on itself, on fabric, on beads.

Sources: Bridson, Fedkiw, Anderson, "Robust Treatment of Collisions, Contact and Friction for Cloth
Animation", 2002 (a layer has a thickness and two sides); Macklin et al., "XPBD", 2016.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..lanes.lane_access import lane_access
from ..lanes.structures import structures
from .closest_point import closest_point
from .table_support import CARRIED, table_support

__all__ = ["ACTS", "CARRIES", "RIM", "triangle_contact"]

ACTS = 1
CARRIES = 2
RIM = 0.3
"""What is behind a plane, and farther than this share of the distance at which they touch from the
rim of what lies in it, has come round the rim."""


@functools.cache
def triangle_contact(scalar: Any, lanes: int) -> SimpleNamespace:
    """`project_triangles(...)`: solve the listed pairs of one lane, in the order of the list.

    A particle stays on the side of a triangle on which it was listed, also while they are listed
    anew (see `cell_list`). It changes sides when it has come round the rim, or is through and
    farther than they touch. The normal is the triangle's where the nearest point is inside, else
    from the nearest point to the particle. As between
    particles, a correction separates at `recovery` at most, counting what already separates, so an
    overlap that takes many substeps to undo does not gather speed.

    Returns whether the particle `held` (local number, or -1) touched a triangle below it.
    """
    t = structures(scalar, lanes)
    S, R3, L = t.S, t.R3, t.L
    Topology, Sheets, Cells = t.Topology, t.Sheets, t.Cells
    access = lane_access(scalar, lanes)
    get, put, get_mass = access.get, access.put, access.get_mass
    barycentric = closest_point(scalar, lanes).barycentric
    support = table_support(scalar, lanes)
    raised, carried = support.raised, support.carried

    @wp.func
    def project_triangle(
        k: int,
        lane: int,
        p0: int,
        radii: int,
        held: int,
        mu: S,
        max_recovery: S,
        top: Topology,
        sheets: Sheets,
        cells: Cells,
    ):
        """One pair; returns the sum of ACTS where it moved and CARRIES where `held` lies on it."""
        result = int(0)
        face = cells.face[k]
        tri = sheets.triangle[face]
        signed = cells.gap[k]
        i = p0 + cells.particle[k]
        ia = p0 + tri[0]
        ib = p0 + tri[1]
        ic = p0 + tri[2]
        xi = get(cells.x, i, lane)
        xa = get(cells.x, ia, lane)
        xb = get(cells.x, ib, lane)
        xc = get(cells.x, ic, lane)
        p = raised(xi, top.radius[radii + cells.particle[k]])
        a = raised(xa, top.radius[radii + tri[0]])
        b = raised(xb, top.radius[radii + tri[1]])
        c = raised(xc, top.radius[radii + tri[2]])
        h = wp.abs(signed)
        m = wp.cross(b - a, c - a) * wp.sign(signed)
        m2 = wp.dot(m, m)
        above = wp.dot(p - a, m)
        # most listed pairs are farther from the triangle's plane than they touch
        if above <= S(0.0) or above * above < h * h * m2:
            u = barycentric(p, a, b, c)
            d = p - (a * u[0] + b * u[1] + c * u[2])
            n = R3()
            depth = S(0.0)
            if wp.min(u[0], wp.min(u[1], u[2])) > S(1.0e-6):
                n = m / wp.max(wp.sqrt(m2), S(1.0e-20))
                depth = h - wp.dot(d, n)
                if depth > S(2.0) * h:
                    cells.gap[k] = -signed
                    depth = S(0.0)
            else:
                l = wp.length(d)
                if wp.dot(d, m) > S(0.0):
                    if l < h and l > S(1.0e-8):
                        n = d / l
                        depth = h - l
                elif l > S(RIM) * h:
                    cells.gap[k] = -signed
            if depth > S(0.0):
                # what hangs beside it does not carry it
                if cells.particle[k] == held and n[2] > S(0.5):
                    result = wp.static(CARRIES)
                wi = get_mass(cells.w, i, lane)
                wa = get_mass(cells.w, ia, lane) * u[0]
                wb = get_mass(cells.w, ib, lane) * u[1]
                wc = get_mass(cells.w, ic, lane) * u[2]
                w = wi + wa * u[0] + wb * u[1] + wc * u[2]
                borne = carried(n[2], p, xi, wi) + carried(-n[2], a, xa, wa * u[0])
                borne += carried(-n[2], b, xb, wb * u[1]) + carried(-n[2], c, xc, wc * u[2])
                firm = w - S(CARRIED) * n[2] * n[2] * borne
                moved = p - get(cells.xp, i, lane)
                moved -= (a - get(cells.xp, ia, lane)) * u[0]
                moved -= (b - get(cells.xp, ib, lane)) * u[1]
                moved -= (c - get(cells.xp, ic, lane)) * u[2]
                approach = wp.dot(moved, n)
                depth = wp.min(depth, wp.max(max_recovery - approach, S(0.0)))
                if depth > S(0.0) and w > S(0.0):
                    slip = moved - n * approach
                    budget = depth * mu * sheets.friction[face] * (w / firm)
                    share = budget / wp.max(
                        wp.sqrt(wp.dot(slip, slip) + budget * budget), S(1.0e-12)
                    )
                    step = n * (depth / firm) - slip * (share / w)
                    put(cells.x, i, lane, xi + step * wi)
                    put(cells.x, ia, lane, xa - step * wa)
                    put(cells.x, ib, lane, xb - step * wb)
                    put(cells.x, ic, lane, xc - step * wc)
                    result += wp.static(ACTS)
        return result

    @wp.func
    def project_triangles(
        g: int,
        lane: int,
        p0: int,
        radii: int,
        held: int,
        mu: S,
        max_recovery: S,
        top: Topology,
        sheets: Sheets,
        cells: Cells,
    ):
        hit = bool(False)
        start = cells.list_start[g] + lane * cells.capacity[g]
        for k in range(start, start + cells.count[g * wp.static(L) + lane]):
            result = project_triangle(
                k, lane, p0, radii, held, mu, max_recovery, top, sheets, cells
            )
            hit = hit or result >= wp.static(CARRIES)
        return hit

    return SimpleNamespace(project_triangles=project_triangles, project_triangle=project_triangle)
