"""Adjoint of contact between particles and triangles, see `triangle_contact`."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..lanes.lane_access import lane_access
from ..lanes.structures import structures
from ..lanes.tape import TRIANGLE_SCALARS, TRIANGLE_WORDS, Kind, tape
from .closest_point import closest_point, closest_point_adjoint
from .friction import friction_adjoint
from .table_support import CARRIED, table_support
from .triangle_contact import ACTS, CARRIES, triangle_contact

__all__ = ["triangle_contact_adjoint"]


@functools.cache
def triangle_contact_adjoint(scalar: Any, lanes: int) -> SimpleNamespace:
    """`record_triangles` solves the listed pairs of one lane and leaves those that acted on the
    tape; it returns 2 * their number, plus 1 where `held` touched a triangle below it.
    `sweep_triangle` takes one back and returns the derivative by friction.

    Branches: inside, rim or corner of the triangle; on which side the particle is kept; depth
    limited by the overlap or by `recovery`; who lies on the table.
    """
    t = structures(scalar, lanes)
    S, R3, L = t.S, t.R3, t.L
    Topology, Sheets, Cells = t.Topology, t.Sheets, t.Cells
    Tape, Adjoint = t.Tape, t.Adjoint
    access = lane_access(scalar, lanes)
    get, put, get_mass, put_scalar = access.get, access.put, access.get_mass, access.put_scalar
    barycentric = closest_point(scalar, lanes).barycentric
    sweep_barycentric = closest_point_adjoint(scalar, lanes).sweep_barycentric
    project_triangle = triangle_contact(scalar, lanes).project_triangle
    position = tape(scalar, lanes).position
    support = table_support(scalar, lanes)
    raised, carried, unraised = support.raised, support.carried, support.unraised
    soft_gradients = friction_adjoint(scalar, lanes).coulomb_soft_scalar_gradients

    @wp.func
    def record_four(at: int, gap: S, p: R3, a: R3, b: R3, c: R3, tape: Tape):
        tape.s[at] = gap
        for axis in range(3):
            tape.s[at + 1 + axis] = p[axis]
            tape.s[at + 4 + axis] = a[axis]
            tape.s[at + 7 + axis] = b[axis]
            tape.s[at + 10 + axis] = c[axis]

    @wp.func
    def add_to(x: wp.array(dtype=S), xp: wp.array(dtype=S), i: int, lane: int, gx: R3, gp: R3):
        put(x, i, lane, get(x, i, lane) + gx)
        put(xp, i, lane, get(xp, i, lane) + gp)

    @wp.func
    def add_mass(i: int, lane: int, w: S, g: S, adj: Adjoint):
        if w > S(0.0):
            put_scalar(adj.mass_flat, i, lane, get_mass(adj.mass_flat, i, lane) + g)

    @wp.func
    def lowered(i: int, lane: int, g: R3, z: R3, x: R3, adj: Adjoint):
        """`unraised`; what raised the particle was its radius."""
        if z[2] > x[2]:
            put_scalar(adj.radius_flat, i, lane, get_mass(adj.radius_flat, i, lane) + g[2])
        return unraised(g, z, x)

    @wp.func
    def record_triangles(
        g: int,
        lane: int,
        p0: int,
        radii: int,
        held: int,
        at_word: int,
        at_scalar: int,
        mu: S,
        max_recovery: S,
        top: Topology,
        sheets: Sheets,
        cells: Cells,
        tape: Tape,
    ):
        hit = int(0)
        count = int(0)
        start = cells.list_start[g] + lane * cells.capacity[g]
        for k in range(start, start + cells.count[g * wp.static(L) + lane]):
            face = cells.face[k]
            i = cells.particle[k]
            tri = sheets.triangle[face]
            p = get(cells.x, p0 + i, lane)
            a = get(cells.x, p0 + tri[0], lane)
            b = get(cells.x, p0 + tri[1], lane)
            c = get(cells.x, p0 + tri[2], lane)
            result = project_triangle(
                k, lane, p0, radii, held, mu, max_recovery, top, sheets, cells
            )
            if result >= wp.static(CARRIES):
                hit = 1
            if result % wp.static(CARRIES) == wp.static(ACTS):
                word = at_word + count * wp.static(TRIANGLE_WORDS)
                tape.k[word] = i
                tape.k[word + 1] = face
                record_four(
                    at_scalar + count * wp.static(TRIANGLE_SCALARS), cells.gap[k], p, a, b, c, tape
                )
                count += 1
        return 2 * count + hit

    @wp.func
    def sweep_triangle(
        word: int,
        at: int,
        finished: int,
        lane: int,
        p0: int,
        radii: int,
        mu: S,
        max_recovery: S,
        counts: int,
        top: Topology,
        sheets: Sheets,
        tape: Tape,
        adj: Adjoint,
    ):
        local = tape.k[word]
        face = tape.k[word + 1]
        tri = sheets.triangle[face]
        signed = tape.s[at]
        xi = position(at + 1, tape)
        xa = position(at + 4, tape)
        xb = position(at + 7, tape)
        xc = position(at + 10, tape)
        p = raised(xi, top.radius[radii + local])
        a = raised(xa, top.radius[radii + tri[0]])
        b = raised(xb, top.radius[radii + tri[1]])
        c = raised(xc, top.radius[radii + tri[2]])
        i = p0 + local
        ia = p0 + tri[0]
        ib = p0 + tri[1]
        ic = p0 + tri[2]
        h = wp.abs(signed)
        side = wp.sign(signed)
        m = wp.cross(b - a, c - a) * side
        m2 = wp.dot(m, m)
        u = barycentric(p, a, b, c)
        d = p - (a * u[0] + b * u[1] + c * u[2])
        inside = wp.min(u[0], wp.min(u[1], u[2])) > S(1.0e-6)
        size = wp.max(wp.sqrt(m2), S(1.0e-20))
        l = wp.length(d)
        n = m / size
        overlap = h - wp.dot(d, n)
        kind = counts + wp.static(int(Kind.TRIANGLE_FACE))
        if not inside:
            n = d / l
            overlap = h - l
            kind = counts + wp.static(int(Kind.TRIANGLE_RIM))
        fired = adj.fired[kind]
        fired[lane] = fired[lane] + S(1.0)
        adj.fired[kind] = fired
        wi = get_mass(adj.w_flat, i, lane)
        wa = get_mass(adj.w_flat, ia, lane)
        wb = get_mass(adj.w_flat, ib, lane)
        wc = get_mass(adj.w_flat, ic, lane)
        w = wi + wa * u[0] * u[0] + wb * u[1] * u[1] + wc * u[2] * u[2]
        # who is carried, and their share of w
        ci = carried(n[2], p, xi, S(1.0))
        ca = carried(-n[2], a, xa, S(1.0))
        cb = carried(-n[2], b, xb, S(1.0))
        cc = carried(-n[2], c, xc, S(1.0))
        borne = ci * wi + ca * wa * u[0] * u[0] + cb * wb * u[1] * u[1] + cc * wc * u[2] * u[2]
        upright = S(CARRIED) * n[2] * n[2]
        firm = w - upright * borne
        sa = a - get(tape.x_flat, finished + 3 * tri[0] + 1, lane)
        sb = b - get(tape.x_flat, finished + 3 * tri[1] + 1, lane)
        sc = c - get(tape.x_flat, finished + 3 * tri[2] + 1, lane)
        moved = p - get(tape.x_flat, finished + 3 * local + 1, lane)
        moved -= sa * u[0] + sb * u[1] + sc * u[2]
        approach = wp.dot(moved, n)
        allowed = wp.max(max_recovery - approach, S(0.0))
        depth = wp.min(overlap, allowed)
        slip = moved - n * approach
        slip2 = wp.dot(slip, slip)
        rub = mu * sheets.friction[face]
        load = depth * (w / firm)
        budget = load * rub
        share, by_budget, by_slip2 = soft_gradients(slip2, budget)
        press = n * (depth / firm)
        drag = slip * (share / w)
        step = press - drag

        gp = get(adj.x_flat, i, lane)
        ga = get(adj.x_flat, ia, lane)
        gb = get(adj.x_flat, ib, lane)
        gc = get(adj.x_flat, ic, lane)
        # by the step and by the inverse masses that share it
        g_step = gp * wi - ga * (wa * u[0]) - gb * (wb * u[1]) - gc * (wc * u[2])
        ya = -wp.dot(ga, step)
        yb = -wp.dot(gb, step)
        yc = -wp.dot(gc, step)
        b_ = g_step / w
        across = -wp.dot(b_, slip)
        g_budget = across * by_budget
        g_firm = -(wp.dot(g_step, press) + g_budget * budget) / firm
        gw = (wp.dot(g_step, drag) + g_budget * budget) / w + g_firm
        g_borne = -upright * g_firm
        wga = gw + g_borne * ca
        wgb = gw + g_borne * cb
        wgc = gw + g_borne * cc
        add_mass(i, lane, wi, wp.dot(gp, step) + gw + g_borne * ci, adj)
        add_mass(ia, lane, wa, u[0] * (ya + wga * u[0]), adj)
        add_mass(ib, lane, wb, u[1] * (yb + wgb * u[1]), adj)
        add_mass(ic, lane, wc, u[2] * (yc + wgc * u[2]), adj)
        # by depth, slip and normal
        g_depth = wp.dot(g_step, n) / firm + g_budget * rub * (w / firm)
        g_slip = slip * (S(2.0) * across * by_slip2) - b_ * share
        g_approach = -wp.dot(g_slip, n)
        g_overlap = g_depth
        if allowed < overlap:
            g_approach -= g_depth
            g_overlap = S(0.0)
        gn = g_step * (depth / firm) - g_slip * approach + moved * g_approach
        gn[2] = gn[2] - S(2.0) * S(CARRIED) * n[2] * borne * g_firm
        g_moved = g_slip + n * g_approach
        # by the offset from the nearest point, its weights, and the triangle's plane
        gd = R3()
        ge = R3()
        gf = R3()
        if inside:
            gd = n * (-g_overlap)
            gn -= d * g_overlap
            gm = (gn - n * wp.dot(n, gn)) * (side / size)
            ge = wp.cross(c - a, gm)
            gf = wp.cross(gm, b - a)
        else:
            gd = (gn - n * wp.dot(n, gn)) / l - n * g_overlap
        # the weights add up to 1, so positions count from a
        gu = R3(
            ya * wa + S(2.0) * wga * wa * u[0] - wp.dot(g_moved, sa),
            yb * wb + S(2.0) * wgb * wb * u[1] - wp.dot(g_moved, sb) - wp.dot(gd, b - a),
            yc * wc + S(2.0) * wgc * wc * u[2] - wp.dot(g_moved, sc) - wp.dot(gd, c - a),
        )
        hp, ha, hb, hc = sweep_barycentric(u, gu, d, a, b, c)
        g = g_moved + gd
        hp = lowered(i, lane, hp + g, p, xi, adj)
        ha = lowered(ia, lane, ha - g * u[0] - ge - gf, a, xa, adj)
        hb = lowered(ib, lane, hb - g * u[1] + ge, b, xb, adj)
        hc = lowered(ic, lane, hc - g * u[2] + gf, c, xc, adj)
        add_to(adj.x_flat, adj.xp_flat, i, lane, hp, -g_moved)
        add_to(adj.x_flat, adj.xp_flat, ia, lane, ha, g_moved * u[0])
        add_to(adj.x_flat, adj.xp_flat, ib, lane, hb, g_moved * u[1])
        add_to(adj.x_flat, adj.xp_flat, ic, lane, hc, g_moved * u[2])
        return g_budget * load * sheets.friction[face]

    return SimpleNamespace(
        record_triangles=record_triangles,
        sweep_triangle=sweep_triangle,
        record_four=record_four,
        add_to=add_to,
        add_mass=add_mass,
        lowered=lowered,
    )
