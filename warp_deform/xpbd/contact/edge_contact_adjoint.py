"""Adjoint of contact between edges of triangles, see `edge_contact`."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..lanes.lane_access import lane_access
from ..lanes.structures import structures
from ..lanes.tape import TRIANGLE_SCALARS, TRIANGLE_WORDS, Kind, tape
from .closest_point import closest_point_adjoint
from .edge_contact import edge_contact
from .table_support import CARRIED, table_support
from .triangle_contact_adjoint import triangle_contact_adjoint

__all__ = ["edge_contact_adjoint"]


@functools.cache
def edge_contact_adjoint(scalar: Any, lanes: int) -> SimpleNamespace:
    """`record_edges` solves the listed pairs of one lane, leaves those that acted on the tape and
    returns their number; `sweep_edge` takes one back.

    Branches: only pairs that meet inside both edges act, on the sides on which they are kept; depth
    is limited by the overlap or by `recovery`; who lies on the table.
    """
    t = structures(scalar, lanes)
    S, R3, L = t.S, t.R3, t.L
    R2 = wp.types.vector(2, S)
    Topology, Sheets, Cells = t.Topology, t.Sheets, t.Cells
    Tape, Adjoint = t.Tape, t.Adjoint
    access = lane_access(scalar, lanes)
    count_one = access.count_one
    get, get_mass = access.get, access.get_mass
    edges_ = edge_contact(scalar, lanes)
    nearest, project_edge = edges_.nearest, edges_.project_edge
    along_two = closest_point_adjoint(scalar, lanes).along_two
    tri_ = triangle_contact_adjoint(scalar, lanes)
    lowered = tri_.lowered
    record_four, add_to, add_mass = tri_.record_four, tri_.add_to, tri_.add_mass
    position = tape(scalar, lanes).position
    support = table_support(scalar, lanes)
    raised, carried = support.raised, support.carried

    @wp.func
    def record_edges(
        g: int,
        lane: int,
        p0: int,
        radii: int,
        at_word: int,
        at_scalar: int,
        max_recovery: S,
        top: Topology,
        sheets: Sheets,
        cells: Cells,
        tape: Tape,
    ):
        count = int(0)
        start = cells.list_start[g] + lane * cells.capacity[g]
        for k in range(start, start + cells.edge_count[g * wp.static(L) + lane]):
            e = sheets.edge[cells.edge_a[k]]
            f = sheets.edge[cells.edge_b[k]]
            a = get(cells.x, p0 + e[0], lane)
            b = get(cells.x, p0 + e[1], lane)
            c = get(cells.x, p0 + f[0], lane)
            d = get(cells.x, p0 + f[1], lane)
            acts = project_edge(k, lane, p0, radii, max_recovery, top, sheets, cells)
            if acts:
                word = at_word + count * wp.static(TRIANGLE_WORDS)
                tape.k[word] = cells.edge_a[k]
                tape.k[word + 1] = cells.edge_b[k]
                at = at_scalar + count * wp.static(TRIANGLE_SCALARS)
                record_four(at, cells.edge_gap[k], a, b, c, d, tape)
                count += 1
        return count

    @wp.func
    def sweep_edge(
        word: int,
        at: int,
        finished: int,
        lane: int,
        p0: int,
        radii: int,
        max_recovery: S,
        counts: int,
        top: Topology,
        sheets: Sheets,
        tape: Tape,
        adj: Adjoint,
    ):
        first = sheets.edge[tape.k[word]]
        second = sheets.edge[tape.k[word + 1]]
        signed = tape.s[at]
        xa = position(at + 1, tape)
        xb = position(at + 4, tape)
        xc = position(at + 7, tape)
        xd = position(at + 10, tape)
        a = raised(xa, top.radius[radii + first[0]])
        b = raised(xb, top.radius[radii + first[1]])
        c = raised(xc, top.radius[radii + second[0]])
        d = raised(xd, top.radius[radii + second[1]])
        ia = p0 + first[0]
        ib = p0 + first[1]
        ic = p0 + second[0]
        id = p0 + second[1]
        kind = counts + wp.static(int(Kind.EDGE))
        count_one(kind, lane, adj)
        h = wp.abs(signed)
        side = wp.sign(signed)
        e = b - a
        f = d - c
        n = wp.cross(e, f) * side
        size = wp.length(n)
        n = n / size
        at_both = nearest(a, b, c, d)
        u = at_both[0]
        v = at_both[1]
        nu = S(1.0) - u
        nv = S(1.0) - v
        wa = get_mass(adj.w_flat, ia, lane)
        wb = get_mass(adj.w_flat, ib, lane)
        wc = get_mass(adj.w_flat, ic, lane)
        wd = get_mass(adj.w_flat, id, lane)
        w = wa * nu * nu + wb * u * u + wc * nv * nv + wd * v * v
        # who is carried, and their share of w
        ca = carried(n[2], a, xa, S(1.0))
        cb = carried(n[2], b, xb, S(1.0))
        cc = carried(-n[2], c, xc, S(1.0))
        cd = carried(-n[2], d, xd, S(1.0))
        borne = ca * wa * nu * nu + cb * wb * u * u + cc * wc * nv * nv + cd * wd * v * v
        upright = S(CARRIED) * n[2] * n[2]
        w -= upright * borne
        sa = a - get(tape.x_flat, finished + 3 * first[0] + 1, lane)
        sb = b - get(tape.x_flat, finished + 3 * first[1] + 1, lane)
        sc = c - get(tape.x_flat, finished + 3 * second[0] + 1, lane)
        sd = d - get(tape.x_flat, finished + 3 * second[1] + 1, lane)
        moved = sa * nu + sb * u - sc * nv - sd * v
        r = a + e * u - c - f * v
        overlap = h - wp.dot(r, n)
        allowed = wp.max(max_recovery - wp.dot(moved, n), S(0.0))
        depth = wp.min(overlap, allowed)
        step = n * (depth / w)

        ga = get(adj.x_flat, ia, lane)
        gb = get(adj.x_flat, ib, lane)
        gc = get(adj.x_flat, ic, lane)
        gd = get(adj.x_flat, id, lane)
        g_step = ga * (wa * nu) + gb * (wb * u) - gc * (wc * nv) - gd * (wd * v)
        ya = wp.dot(ga, step)
        yb = wp.dot(gb, step)
        yc = -wp.dot(gc, step)
        yd = -wp.dot(gd, step)
        gw = -wp.dot(g_step, step) / w
        wga = gw * (S(1.0) - upright * ca)
        wgb = gw * (S(1.0) - upright * cb)
        wgc = gw * (S(1.0) - upright * cc)
        wgd = gw * (S(1.0) - upright * cd)
        add_mass(ia, lane, wa, nu * (ya + wga * nu), adj)
        add_mass(ib, lane, wb, u * (yb + wgb * u), adj)
        add_mass(ic, lane, wc, nv * (yc + wgc * nv), adj)
        add_mass(id, lane, wd, v * (yd + wgd * v), adj)
        g_depth = wp.dot(g_step, n) / w
        gn = g_step * (depth / w)
        gn[2] = gn[2] - S(2.0) * S(CARRIED) * n[2] * borne * gw
        g_moved = R3()
        gr = R3()
        if allowed < overlap:
            if allowed > S(0.0):
                gn -= moved * g_depth
                g_moved = n * (-g_depth)
        else:
            gn -= r * g_depth
            gr = n * (-g_depth)
        gu = yb * wb - ya * wa + S(2.0) * (wgb * wb * u - wga * wa * nu)
        gu += wp.dot(g_moved, sb - sa) + wp.dot(gr, e)
        gv = yd * wd - yc * wc + S(2.0) * (wgd * wd * v - wgc * wc * nv)
        gv -= wp.dot(g_moved, sd - sc) + wp.dot(gr, f)
        gm = (gn - n * wp.dot(n, gn)) * (side / size)
        # shares: from a along e, and from there to c against f
        y = along_two(-r, R2(u, v), e, -f, R2(gu, gv))
        across = R3(y[0, 0], y[0, 1], y[0, 2])
        ge = wp.cross(f, gm) + R3(y[1, 0], y[1, 1], y[1, 2])
        gf = wp.cross(gm, e) - R3(y[2, 0], y[2, 1], y[2, 2])
        g = gr + g_moved
        ha = lowered(ia, lane, g * nu - across - ge, a, xa, adj)
        hb = lowered(ib, lane, g * u + ge, b, xb, adj)
        hc = lowered(ic, lane, across - g * nv - gf, c, xc, adj)
        hd = lowered(id, lane, gf - g * v, d, xd, adj)
        add_to(adj.x_flat, adj.xp_flat, ia, lane, ha, g_moved * (-nu))
        add_to(adj.x_flat, adj.xp_flat, ib, lane, hb, g_moved * (-u))
        add_to(adj.x_flat, adj.xp_flat, ic, lane, hc, g_moved * nv)
        add_to(adj.x_flat, adj.xp_flat, id, lane, hd, g_moved * v)

    return SimpleNamespace(record_edges=record_edges, sweep_edge=sweep_edge)
