"""Adjoint of contact between particles and boxes, see `box_particle`."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..lanes.algebra import add, mul, sub  # noqa: F401  (operators are found by name)
from ..lanes.lane_access import lane_access
from ..lanes.structures import structures
from ..lanes.tape import Kind
from .box_particle import box_particle
from .rigid_body import rigid
from .rigid_body_adjoint import rigid_adjoint

__all__ = ["box_particle_adjoint"]


@functools.cache
def box_particle_adjoint(scalar: Any, lanes: int) -> SimpleNamespace:
    """`record_box_particle` solves a pair and leaves both positions and the pose on the tape where
    it touches (it returns whether it does); `sweep_box_particle` takes it back and returns the
    derivative by friction.

    Branches: nearest point on a face, an edge or a corner, or the nearest face from inside; depth
    limited by the overlap or by `recovery`; a particle that the table carries.
    """
    t = structures(scalar, lanes)
    S, R3, Q, M33 = t.S, t.R3, t.Q, t.M33
    Shapes, Particles, Bodies = t.Shapes, t.Particles, t.Bodies
    Tape, Adjoint, BodyAdjoint = t.Tape, t.Adjoint, t.BodyAdjoint
    access = lane_access(scalar, lanes)
    count_one = access.count_one
    get, put, get_mass, put_scalar = access.get, access.put, access.get_mass, access.put_scalar
    stands = box_particle(scalar, lanes).stands
    project_box_particle = box_particle(scalar, lanes).project_box_particle
    turned = rigid(scalar, lanes).turned
    poses = rigid_adjoint(scalar, lanes)
    push_pose, position, quaternion = poses.push_pose, poses.position, poses.quaternion
    TINY = 1.0e-36 if scalar is wp.float32 else 1.0e-200

    @wp.func
    def stick_share(moved2: S, budget: S):
        """`coulomb_scalar` in a form with a slope at 0."""
        square = budget * budget
        return budget / wp.sqrt(wp.sqrt(wp.max(moved2 * moved2 + square * square, S(TINY))))

    @wp.func
    def resists(w: S, inverse: M33, q: Q, r: R3, n: R3):
        rn = wp.quat_rotate_inv(q, wp.cross(r, n))
        return w + wp.dot(rn, inverse * rn)

    @wp.func
    def pushed(x: R3, q: Q, w: S, inverse: M33, r: R3, impulse: R3, gx: R3, gq: Q):
        """`push_body`, along the derivatives gx, gq."""
        arm = wp.quat_rotate_inv(q, wp.cross(r, impulse))
        to = turned(q, wp.quat_rotate(q, inverse * arm))
        return wp.dot(gx, x + impulse * w) + (
            gq[0] * to[0] + gq[1] * to[1] + gq[2] * to[2] + gq[3] * to[3]
        )

    @wp.func
    def met(
        p: R3, po: R3, wi: S, x: R3, q: Q, xp: R3, qp: Q, w: S, mu: S, inverse: M33, center: R3,
        rotation: Q, h: R3, radius: S, push: S, yielding: S, gp: R3, gx: R3, gq: Q,
    ) -> S:  # fmt: skip
        away = wp.quat_rotate_inv(q, p - x) - center
        at = wp.quat_rotate_inv(rotation, away)
        near = R3(
            wp.clamp(at[0], -h[0], h[0]), wp.clamp(at[1], -h[1], h[1]), wp.clamp(at[2], -h[2], h[2])
        )
        off = at - near
        n = R3(S(0.0), S(0.0), wp.sign(at[2]))
        gap = wp.abs(at[2]) - h[2]
        if wp.length(off) > S(1.0e-8):
            gap = wp.length(off)
            n = off / gap
        else:
            ox = wp.abs(at[0]) - h[0]
            oy = wp.abs(at[1]) - h[1]
            oz = wp.abs(at[2]) - h[2]
            if ox >= oy and ox >= oz:
                n = R3(wp.sign(at[0]), S(0.0), S(0.0))
                gap = ox
            elif oy >= oz:
                n = R3(S(0.0), wp.sign(at[1]), S(0.0))
                gap = oy
        local = center + wp.quat_rotate(rotation, near)
        r = wp.quat_rotate(q, local)
        m = wp.quat_rotate(q, wp.quat_rotate(rotation, n))
        step = p - po - (x + r - (xp + wp.quat_rotate(qp, local)))
        approach = wp.dot(step, m)
        depth = wp.min(radius - gap, wp.max(push - approach, S(0.0)))
        body = resists(w, inverse, q, r, m)
        across = wi + body
        total = wi * yielding + body
        slip = step - m * approach
        budget = depth * mu * across / total
        along = m * (depth / total)
        drag = slip * (stick_share(wp.dot(slip, slip), budget) / across)
        end = p + along * (wi * yielding) - drag * wi
        return wp.dot(gp, end) + pushed(x, q, w, inverse, r, drag - along, gx, gq)

    @wp.func
    def record_box_particle(
        at: int, i: int, lane: int, radius: S, shape: int, b: int, mu: S, push: S, q: Particles,
        shapes: Shapes, bodies: Bodies, tape: Tape,
    ):  # fmt: skip
        before = bodies.touching[b]
        p = q.x[i]
        o = q.xp[i]
        x = bodies.x[b]
        turn = bodies.q[b]
        project_box_particle(i, lane, radius, shape, b, mu, push, q, shapes, bodies)
        hit = bodies.touching[b] > before
        if hit:
            tape.s[at] = p.x[lane]
            tape.s[at + 1] = p.y[lane]
            tape.s[at + 2] = p.z[lane]
            tape.s[at + 3] = o.x[lane]
            tape.s[at + 4] = o.y[lane]
            tape.s[at + 5] = o.z[lane]
            push_pose(at + 6, x, turn, tape)
        return hit

    @wp.func
    def add_to_body(
        b: int, w: S, gx: R3, gq: Q, gxp: R3, gqp: Q, gw: S, ba: BodyAdjoint
    ):  # fmt: skip
        """gx, gq take the place of what was there: a push leaves the rest of a pose as it was."""
        ba.x[b] = gx
        ba.q[b] = gq
        ba.xp[b] = ba.xp[b] + gxp
        ba.qp[b] = ba.qp[b] + gqp
        if w > S(0.0):
            ba.w[b] = ba.w[b] + gw

    @wp.func
    def add_mass(i: int, lane: int, w: S, g: S, adj: Adjoint):
        if w > S(0.0):
            put_scalar(adj.mass_flat, i, lane, get_mass(adj.mass_flat, i, lane) + g)

    @wp.func
    def sweep_box_particle(
        at: int, i: int, lane: int, radius: S, shape: int, b: int, mu: S, push: S, counts: int,
        shapes: Shapes, bodies: Bodies, tape: Tape, ba: BodyAdjoint, adj: Adjoint,
    ):  # fmt: skip
        by_mu = S(0.0)
        p = position(at, tape)
        x = position(at + 6, tape)
        q = quaternion(at + 9, tape)
        wi = get_mass(adj.w_flat, i, lane)
        kind = counts + wp.static(int(Kind.BOX_PARTICLE))
        count_one(kind, lane, adj)
        inverse = M33()
        if bodies.w[b] > S(0.0):
            inverse = bodies.inverse_inertia[b]
        center = shapes.center[shape]
        rotation = shapes.rotation[shape]
        h = shapes.half[shape]
        # which way the box pushes decides whether the table carries the particle
        inside = wp.quat_rotate_inv(rotation, wp.quat_rotate_inv(q, p - x) - center)
        near = R3(
            wp.clamp(inside[0], -h[0], h[0]), wp.clamp(inside[1], -h[1], h[1]),
            wp.clamp(inside[2], -h[2], h[2]),
        )  # fmt: skip
        n = inside - near
        if wp.length(n) > S(1.0e-8):
            n = n / wp.length(n)
        else:
            ox = wp.abs(inside[0]) - h[0]
            oy = wp.abs(inside[1]) - h[1]
            oz = wp.abs(inside[2]) - h[2]
            n = R3(S(0.0), S(0.0), wp.sign(inside[2]))
            if ox >= oy and ox >= oz:
                n = R3(wp.sign(inside[0]), S(0.0), S(0.0))
            elif oy >= oz:
                n = R3(S(0.0), wp.sign(inside[1]), S(0.0))
        down = wp.quat_rotate(q, wp.quat_rotate(rotation, n))[2]
        yielding = stands(p[2], radius, down)
        if wi * yielding + bodies.w[b] > S(0.0):
            rub = shapes.friction[shape]
            (
                gp, gpo, gwi, gx, gq, gxp, gqp, gw, g_mu, _i, _c, _r, _h, _ra, _pu, _y, _g, _gx, _gq
            ) = wp.grad(met)(
                p, position(at + 3, tape), wi, x, q, bodies.xp[b], bodies.qp[b], bodies.w[b],
                mu * rub, inverse, center, rotation, h, radius, push, yielding,
                get(adj.x_flat, i, lane), ba.x[b], ba.q[b],
            )  # fmt: skip
            put(adj.x_flat, i, lane, gp)
            put(adj.xp_flat, i, lane, get(adj.xp_flat, i, lane) + gpo)
            add_mass(i, lane, wi, gwi, adj)
            add_to_body(b, bodies.w[b], gx, gq, gxp, gqp, gw, ba)
            by_mu = g_mu * rub
        return by_mu

    return SimpleNamespace(
        record_box_particle=record_box_particle, sweep_box_particle=sweep_box_particle,
        stick_share=stick_share, resists=resists, pushed=pushed, add_to_body=add_to_body,
        add_mass=add_mass,
    )  # fmt: skip
