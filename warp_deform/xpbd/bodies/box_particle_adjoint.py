"""Adjoint of contact between particles and boxes, see `box_particle`."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..contact.table_support import table_support
from ..lanes.algebra import add, mul, sub  # noqa: F401  (operators are found by name)
from ..lanes.lane_access import lane_access
from ..lanes.structures import structures
from ..lanes.tape import Kind, tape
from .box_particle import box_particle
from .overlap_recovery import overlap_recovery
from .rigid_body import rigid_body

__all__ = ["box_particle_adjoint"]


@functools.cache
def box_particle_adjoint(scalar: Any, lanes: int) -> SimpleNamespace:
    """`record_box_particle` solves a pair and leaves both positions and the pose on the tape where
    it touches (it returns whether it does); `sweep_box_particle` takes it back and returns the
    derivative by friction.

    Branches: nearest point on a face, an edge or a corner, or the nearest face from inside; depth
    limited by the overlap or by `recovery`; a particle that the table carries. The other functions
    are what the adjoint of boxes and triangles has in common with this one.
    """
    t = structures(scalar, lanes)
    S, R3, Q, M33 = t.S, t.R3, t.Q, t.M33
    Shapes, Particles, Bodies = t.Shapes, t.Particles, t.Bodies
    Tape, Adjoint, BodyAdjoint = t.Tape, t.Adjoint, t.BodyAdjoint
    access = lane_access(scalar, lanes)
    count_one = access.count_one
    get, put, get_mass, put_scalar = access.get, access.put, access.get_mass, access.put_scalar
    stands = box_particle(scalar, lanes).stands
    raised = table_support(scalar, lanes).raised
    correction = overlap_recovery(scalar).correction
    project_box_particle = box_particle(scalar, lanes).project_box_particle
    turned = rigid_body(scalar, lanes).turned
    tape_ = tape(scalar, lanes)
    record_pose, position, quaternion = tape_.record_pose, tape_.position, tape_.quaternion
    TINY = 1.0e-36 if scalar is wp.float32 else 1.0e-200

    @wp.struct
    class ParticleValue:
        """A particle before the contact."""

        x: R3
        xp: R3
        w: S

    @wp.struct
    class BodyValue:
        """A body before the contact."""

        x: R3
        q: Q
        xp: R3
        qp: Q
        w: S
        inverse_inertia: M33  # in its own frame, 0 while it is held

    @wp.struct
    class BoxValue:
        """A box in the frame of its body."""

        center: R3
        rotation: Q
        half: R3

    @wp.func
    def taped_body(at: int, b: int, bodies: Bodies, tape: Tape):
        """Body b with the pose on the tape."""
        body = BodyValue()
        body.x = position(at, tape)
        body.q = quaternion(at + 3, tape)
        body.xp = bodies.xp[b]
        body.qp = bodies.qp[b]
        body.w = bodies.w[b]
        body.inverse_inertia = M33()
        if body.w > S(0.0):
            body.inverse_inertia = bodies.inverse_inertia[b]
        return body

    @wp.func
    def box_value(shape: int, shapes: Shapes):
        box = BoxValue()
        box.center = shapes.center[shape]
        box.rotation = shapes.rotation[shape]
        box.half = shapes.half[shape]
        return box

    @wp.func
    def stick_share(moved2: S, budget: S):
        """`coulomb_scalar` in a form that has a derivative at 0."""
        square = budget * budget
        return budget / wp.sqrt(wp.sqrt(wp.max(moved2 * moved2 + square * square, S(TINY))))

    @wp.func
    def response_of(w: S, inverse: M33, q: Q, r: R3, n: R3):
        rn = wp.quat_rotate_inv(q, wp.cross(r, n))
        return w + wp.dot(rn, inverse * rn)

    @wp.func
    def impulse_loss(x: R3, q: Q, w: S, inverse: M33, r: R3, impulse: R3, gx: R3, gq: Q):
        """The derivatives gx, gq times the pose that `apply_impulse` leaves."""
        arm = wp.quat_rotate_inv(q, wp.cross(r, impulse))
        to = turned(q, wp.quat_rotate(q, inverse * arm))
        return wp.dot(gx, x + impulse * w) + (
            gq[0] * to[0] + gq[1] * to[1] + gq[2] * to[2] + gq[3] * to[3]
        )

    @wp.func
    def contact_loss(
        particle: ParticleValue,
        body: BodyValue,
        box: BoxValue,
        mu: S,
        radius: S,
        max_recovery: S,
        yielding: S,
        by_particle: R3,
        by_x: R3,
        by_q: Q,
    ) -> S:
        """The derivatives `by_...` of the loss times what the contact leaves: `wp.grad` of this
        takes the contact back.
        """
        p = raised(particle.x, radius)
        po = particle.xp
        wi = particle.w
        x = body.x
        q = body.q
        xp = body.xp
        qp = body.qp
        w = body.w
        inverse = body.inverse_inertia
        center = box.center
        rotation = box.rotation
        h = box.half
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
        depth = correction(radius - gap, approach, max_recovery)
        response = response_of(w, inverse, q, r, m)
        across = wi + response
        total = wi * yielding + response
        slip = step - m * approach
        budget = depth * mu * across / total
        along = m * (depth / total)
        drag = slip * (stick_share(wp.dot(slip, slip), budget) / across)
        end = particle.x + (along - drag) * wi
        return wp.dot(by_particle, end) + impulse_loss(
            x, q, w, inverse, r, drag - along, by_x, by_q
        )

    @wp.func
    def record_box_particle(
        at: int,
        i: int,
        lane: int,
        radius: S,
        shape: int,
        b: int,
        mu: S,
        max_recovery: S,
        particles: Particles,
        shapes: Shapes,
        bodies: Bodies,
        tape: Tape,
    ):
        before = bodies.touching[b]
        p = particles.x[i]
        o = particles.xp[i]
        x = bodies.x[b]
        turn = bodies.q[b]
        project_box_particle(i, lane, radius, shape, b, mu, max_recovery, particles, shapes, bodies)
        hit = bodies.touching[b] > before
        if hit:
            tape.s[at] = p.x[lane]
            tape.s[at + 1] = p.y[lane]
            tape.s[at + 2] = p.z[lane]
            tape.s[at + 3] = o.x[lane]
            tape.s[at + 4] = o.y[lane]
            tape.s[at + 5] = o.z[lane]
            record_pose(at + 6, x, turn, tape)
        return hit

    @wp.func
    def add_to_body(b: int, w: S, g: BodyValue, ba: BodyAdjoint):
        """g.x, g.q take the place of what was there: they include what the contact left alone."""
        ba.x[b] = g.x
        ba.q[b] = g.q
        ba.xp[b] = ba.xp[b] + g.xp
        ba.qp[b] = ba.qp[b] + g.qp
        if w > S(0.0):
            ba.w[b] = ba.w[b] + g.w

    @wp.func
    def add_mass(i: int, lane: int, w: S, g: S, adj: Adjoint):
        if w > S(0.0):
            put_scalar(adj.mass_flat, i, lane, get_mass(adj.mass_flat, i, lane) + g)

    @wp.func
    def add_radius(i: int, lane: int, g: S, adj: Adjoint):
        put_scalar(adj.radius_flat, i, lane, get_mass(adj.radius_flat, i, lane) + g)

    @wp.func
    def sweep_box_particle(
        at: int,
        i: int,
        lane: int,
        radius: S,
        shape: int,
        b: int,
        mu: S,
        max_recovery: S,
        counts: int,
        shapes: Shapes,
        bodies: Bodies,
        tape: Tape,
        ba: BodyAdjoint,
        adj: Adjoint,
    ):
        by_mu = S(0.0)
        particle = ParticleValue()
        particle.x = position(at, tape)
        particle.xp = position(at + 3, tape)
        particle.w = get_mass(adj.w_flat, i, lane)
        body = taped_body(at + 6, b, bodies, tape)
        box = box_value(shape, shapes)
        kind = counts + wp.static(int(Kind.BOX_PARTICLE))
        count_one(kind, lane, adj)
        h = box.half
        # which way the box pushes decides whether the table carries the particle
        p = raised(particle.x, radius)
        away = wp.quat_rotate_inv(body.q, p - body.x) - box.center
        inside = wp.quat_rotate_inv(box.rotation, away)
        near = R3(
            wp.clamp(inside[0], -h[0], h[0]),
            wp.clamp(inside[1], -h[1], h[1]),
            wp.clamp(inside[2], -h[2], h[2]),
        )
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
        down = wp.quat_rotate(body.q, wp.quat_rotate(box.rotation, n))[2]
        yielding = stands(p[2], radius, down)
        if particle.w * yielding + bodies.w[b] > S(0.0):
            rub = shapes.friction[shape]
            g, g_body, _box, g_mu, g_radius, _recovery, _yielding, _p, _x, _q = wp.grad(
                contact_loss
            )(
                particle,
                body,
                box,
                mu * rub,
                radius,
                max_recovery,
                yielding,
                get(adj.x_flat, i, lane),
                ba.x[b],
                ba.q[b],
            )
            put(adj.x_flat, i, lane, g.x)
            put(adj.xp_flat, i, lane, get(adj.xp_flat, i, lane) + g.xp)
            add_mass(i, lane, particle.w, g.w, adj)
            add_radius(i, lane, g_radius, adj)
            add_to_body(b, body.w, g_body, ba)
            by_mu = g_mu * rub
        return by_mu

    return SimpleNamespace(
        record_box_particle=record_box_particle,
        sweep_box_particle=sweep_box_particle,
        stick_share=stick_share,
        response_of=response_of,
        impulse_loss=impulse_loss,
        BodyValue=BodyValue,
        BoxValue=BoxValue,
        taped_body=taped_body,
        box_value=box_value,
        add_to_body=add_to_body,
        add_mass=add_mass,
        add_radius=add_radius,
    )
