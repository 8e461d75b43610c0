"""Adjoint of the motion of rigid bodies, see `rigid_body`.

Derivatives by a quaternion are those by its four numbers: what a function does is differentiated as
it is computed. The functions called `..._loss`, here and in the other adjoints of bodies, are the
loss to first order: its derivatives by what a function of the forward pass computes, times what
that computes. `wp.grad` of one takes the function back. They say again what the forward pass says:
of a function that a forward kernel also builds, Warp 1.19 gives wrong derivatives and no warning.
What such a function takes is bundled in structs by value, each field read once.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..lanes.lane_access import lane_access
from ..lanes.structures import structures
from ..lanes.tape import Kind, tape
from .rigid_body import STOPS, rigid_body

__all__ = ["rigid_body_adjoint"]


@functools.cache
def rigid_body_adjoint(scalar: Any, lanes: int) -> SimpleNamespace:
    """`record_body` leaves pose, old pose and twist on the tape just before `finish_body` and
    returns whether the body falls asleep; `load_body` brings them back, `sweep_finish_body` and
    `sweep_predict_body` take a body's end and beginning of a substep back.
    """
    t = structures(scalar, lanes)
    S, R3, Q, M33 = t.S, t.R3, t.Q, t.M33
    Bodies, Tape, Adjoint, BodyAdjoint = t.Bodies, t.Tape, t.Adjoint, t.BodyAdjoint
    tape_ = tape(scalar, lanes)
    record_pose, position, quaternion = tape_.record_pose, tape_.position, tape_.quaternion
    count_one = lane_access(scalar, lanes).count_one
    body = rigid_body(scalar, lanes)
    turned, stepped_body, sleep_state = body.turned, body.stepped_body, body.sleep_state

    @wp.func
    def rotate_adjoint(o: R3, q: Q, g: R3):
        """Derivative by q of `g . quat_rotate(q, o)`."""
        v = R3(q[0], q[1], q[2])
        r = (
            wp.cross(o, g) * (S(2.0) * q[3])
            + g * (S(2.0) * wp.dot(v, o))
            + o * (S(2.0) * wp.dot(v, g))
        )
        s = S(4.0) * q[3] * wp.dot(g, o) + S(2.0) * wp.dot(g, wp.cross(v, o))
        return Q(r[0], r[1], r[2], s)

    @wp.func
    def record_body(
        at: int,
        b: int,
        dt: S,
        damping_factor: S,
        gravity: R3,
        drowsy: S,
        bodies: Bodies,
        tape: Tape,
    ):
        record_pose(at, bodies.x[b], bodies.q[b], tape)
        record_pose(at + 7, bodies.xp[b], bodies.qp[b], tape)
        v = bodies.v[b]
        omega = bodies.omega[b]
        for k in range(3):
            tape.s[at + 14 + k] = v[k]
            tape.s[at + 17 + k] = omega[k]
        tape.s[at + 20] = bodies.w[b]
        d = stepped_body(b, dt, damping_factor, gravity, bodies)
        turn = bodies.q[b] * wp.quat_inverse(bodies.qp[b])
        rotation = R3(turn[0], turn[1], turn[2]) * (S(2.0) / turn[3])
        return sleep_state(b, d, rotation, dt, drowsy, bodies)

    @wp.func
    def load_body(at: int, b: int, bodies: Bodies, tape: Tape):
        bodies.x[b] = position(at, tape)
        bodies.q[b] = quaternion(at + 3, tape)
        bodies.xp[b] = position(at + 7, tape)
        bodies.qp[b] = quaternion(at + 10, tape)
        bodies.v[b] = position(at + 14, tape)
        bodies.omega[b] = position(at + 17, tape)
        bodies.w[b] = tape.s[at + 20]

    @wp.func
    def velocity_loss(x: R3, q: Q, xp: R3, qp: Q, dt: S, fastest: S, moves: S, gv: R3, go: R3) -> S:
        d = (x - xp) * moves
        turn = q * Q(-qp[0], -qp[1], -qp[2], qp[3])
        rotation = R3(turn[0], turn[1], turn[2]) * (S(2.0) / turn[3]) * moves
        limit = fastest / wp.max(wp.length(d), fastest) / dt
        return wp.dot(gv, d * limit) + wp.dot(go, rotation * limit)

    @wp.func
    def sweep_finish_body(
        b: int,
        lane: int,
        state: int,
        dt: S,
        fastest: S,
        counts: int,
        bodies: Bodies,
        ba: BodyAdjoint,
        adj: Adjoint,
    ):
        moves = S(1.0)
        kind = int(-1)
        if state > 0:
            kind = counts + wp.static(int(Kind.BODY_SLEEP))
            ba.xp[b] = ba.xp[b] + ba.x[b]
            ba.qp[b] = ba.qp[b] + ba.q[b]
            ba.x[b] = R3()
            ba.q[b] = Q(S(0.0), S(0.0), S(0.0), S(0.0))
            if state == wp.static(STOPS):
                moves = S(0.0)
        elif wp.length(bodies.x[b] - bodies.xp[b]) > fastest:
            kind = counts + wp.static(int(Kind.BODY_CLAMP))
        if kind >= 0:
            count_one(kind, lane, adj)
        gx, gq, gxp, gqp, _dt, _fastest, _moves, _gv, _go = wp.grad(velocity_loss)(
            bodies.x[b],
            bodies.q[b],
            bodies.xp[b],
            bodies.qp[b],
            dt,
            fastest,
            moves,
            ba.v[b],
            ba.omega[b],
        )
        ba.x[b] = ba.x[b] + gx
        ba.q[b] = ba.q[b] + gq
        ba.xp[b] = ba.xp[b] + gxp
        ba.qp[b] = ba.qp[b] + gqp
        ba.v[b] = R3()
        ba.omega[b] = R3()

    @wp.func
    def prediction_loss(
        x: R3,
        q: Q,
        v: R3,
        omega: R3,
        dt: S,
        damping_factor: S,
        gravity: R3,
        tensor: M33,
        inverse: M33,
        gx: R3,
        gq: Q,
    ) -> S:
        to = x + (v + gravity * dt) * (dt * damping_factor)
        spin = wp.quat_rotate_inv(q, omega)
        half = spin - inverse * wp.cross(spin, tensor * spin) * (S(0.5) * dt)
        late = spin - inverse * wp.cross(half, tensor * half) * dt
        turn = turned(q, wp.quat_rotate(q, late) * (dt * damping_factor))
        return wp.dot(gx, to) + (
            gq[0] * turn[0] + gq[1] * turn[1] + gq[2] * turn[2] + gq[3] * turn[3]
        )

    @wp.func
    def sweep_predict_body(
        b: int, dt: S, damping_factor: S, gravity: R3, bodies: Bodies, ba: BodyAdjoint
    ):
        """Returns the derivative by the share of velocity that is damping_factor."""
        by_damping = S(0.0)
        gxp = ba.xp[b]
        gqp = ba.qp[b]
        if bodies.w[b] > S(0.0):
            gx, gq, gv, go, _dt, gk, _g, _t, _i, _gx, _gq = wp.grad(prediction_loss)(
                bodies.xp[b],
                bodies.qp[b],
                bodies.v[b],
                bodies.omega[b],
                dt,
                damping_factor,
                gravity,
                bodies.inertia[b],
                bodies.inverse_inertia[b],
                ba.x[b],
                ba.q[b],
            )
            ba.x[b] = gxp + gx
            ba.q[b] = gqp + gq
            ba.v[b] = ba.v[b] + gv
            ba.omega[b] = ba.omega[b] + go
            by_damping = gk
        else:
            ba.x[b] = ba.x[b] + gxp
            ba.q[b] = ba.q[b] + gqp
        ba.xp[b] = R3()
        ba.qp[b] = Q(S(0.0), S(0.0), S(0.0), S(0.0))
        return by_damping

    return SimpleNamespace(
        record_body=record_body,
        load_body=load_body,
        sweep_finish_body=sweep_finish_body,
        sweep_predict_body=sweep_predict_body,
        rotate_adjoint=rotate_adjoint,
    )
