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
from .triangle_contact import ACTS, CARRIES, triangle_contact

__all__ = ["triangle_contact_adjoint"]


@functools.cache
def triangle_contact_adjoint(scalar: Any, lanes: int) -> SimpleNamespace:
    """`record_triangles` solves the listed pairs of one lane and leaves those that acted on the
    tape; it returns 2 * their number, plus 1 where `held` touched a triangle below it.
    `sweep_triangle` takes one back and returns the derivative by friction.

    Branches: inside, rim or corner of the triangle; on which side it was listed; depth limited by
    the overlap or by `recovery`.
    """
    t = structures(scalar, lanes)
    S, R3, L = t.S, t.R3, t.L
    Sheets, Cells, Tape, Adjoint = t.Sheets, t.Cells, t.Tape, t.Adjoint
    access = lane_access(scalar, lanes)
    get, put, get_mass, put_scalar = access.get, access.put, access.get_mass, access.put_scalar
    barycentric = closest_point(scalar, lanes).barycentric
    sweep_barycentric = closest_point_adjoint(scalar, lanes).sweep_barycentric
    project_triangle = triangle_contact(scalar, lanes).project_triangle
    position = tape(scalar, lanes).position
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
    def record_triangles(
        g: int,
        lane: int,
        p0: int,
        held: int,
        at_word: int,
        at_scalar: int,
        mu: S,
        max_recovery: S,
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
            result = project_triangle(k, lane, p0, held, mu, max_recovery, sheets, cells)
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
        mu: S,
        max_recovery: S,
        counts: int,
        sheets: Sheets,
        tape: Tape,
        adj: Adjoint,
    ):
        local = tape.k[word]
        face = tape.k[word + 1]
        tri = sheets.triangle[face]
        signed = tape.s[at]
        p = position(at + 1, tape)
        a = position(at + 4, tape)
        b = position(at + 7, tape)
        c = position(at + 10, tape)
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
        budget = depth * rub
        share, by_budget, by_slip2 = soft_gradients(slip2, budget)
        step = (n * depth - slip * share) / w

        gp = get(adj.x_flat, i, lane)
        ga = get(adj.x_flat, ia, lane)
        gb = get(adj.x_flat, ib, lane)
        gc = get(adj.x_flat, ic, lane)
        # by the step and by the inverse masses that share it
        g_step = gp * wi - ga * (wa * u[0]) - gb * (wb * u[1]) - gc * (wc * u[2])
        ya = -wp.dot(ga, step)
        yb = -wp.dot(gb, step)
        yc = -wp.dot(gc, step)
        gw = -wp.dot(g_step, step) / w
        add_mass(i, lane, wi, wp.dot(gp, step) + gw, adj)
        add_mass(ia, lane, wa, u[0] * (ya + gw * u[0]), adj)
        add_mass(ib, lane, wb, u[1] * (yb + gw * u[1]), adj)
        add_mass(ic, lane, wc, u[2] * (yc + gw * u[2]), adj)
        # by depth, slip and normal
        b_ = g_step / w
        across = -wp.dot(b_, slip)
        g_budget = across * by_budget
        g_depth = wp.dot(b_, n) + g_budget * rub
        g_slip = slip * (S(2.0) * across * by_slip2) - b_ * share
        g_approach = -wp.dot(g_slip, n)
        g_overlap = g_depth
        if allowed < overlap:
            g_approach -= g_depth
            g_overlap = S(0.0)
        gn = b_ * depth - g_slip * approach + moved * g_approach
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
            ya * wa + S(2.0) * gw * wa * u[0] - wp.dot(g_moved, sa),
            yb * wb + S(2.0) * gw * wb * u[1] - wp.dot(g_moved, sb) - wp.dot(gd, b - a),
            yc * wc + S(2.0) * gw * wc * u[2] - wp.dot(g_moved, sc) - wp.dot(gd, c - a),
        )
        hp, ha, hb, hc = sweep_barycentric(u, gu, d, a, b, c)
        g = g_moved + gd
        add_to(adj.x_flat, adj.xp_flat, i, lane, hp + g, -g_moved)
        add_to(adj.x_flat, adj.xp_flat, ia, lane, ha - g * u[0] - ge - gf, g_moved * u[0])
        add_to(adj.x_flat, adj.xp_flat, ib, lane, hb - g * u[1] + ge, g_moved * u[1])
        add_to(adj.x_flat, adj.xp_flat, ic, lane, hc - g * u[2] + gf, g_moved * u[2])
        return g_budget * depth * sheets.friction[face]

    return SimpleNamespace(
        record_triangles=record_triangles,
        sweep_triangle=sweep_triangle,
        record_four=record_four,
        add_to=add_to,
        add_mass=add_mass,
    )
