"""Rigid bodies: free motion, impulses, and the velocity update.

Source: Mueller, Macklin, Chentanez, Jeschke, Kim, "Detailed Rigid Body Simulation with Extended
Position Based Dynamics", 2020, algorithm 2. Bodies are simulated lane by lane in scalar code: their
contacts branch too differently between worlds for lanes to pay.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..lanes.structures import structures

__all__ = ["rigid_body"]

SLEEP_SPEED = 0.004
"""A supported body slower than this [m/s] stays where it is: without it, the order in which the
corners are solved lets a resting box creep. It keeps its velocity, so that a force which friction
does not hold still accelerates it, and it moves off once it is faster."""
SLEEP_TURN = 0.05
"""The same for its angular speed [rad/s]."""
AWAKE, STAYS, STOPS = 0, 1, 2
"""A sleeping body stays where it was; late in a world of fabrics it loses its velocity as well."""


@functools.cache
def rigid_body(scalar: Any, lanes: int) -> SimpleNamespace:
    """`predict_body` begins a substep of a body, `apply_impulse` moves it, `finish_body` ends it.

    Contacts also ask for its `response` to an impulse, and how far a point of it has `moved`.
    `turned`, `stepped_body` and `sleep_state` are what the adjoint shares with these.
    """
    t = structures(scalar, lanes)
    S, R3, Q, Bodies = t.S, t.R3, t.Q, t.Bodies

    @wp.func
    def turned(q: Q, rotation: R3):
        """`q` turned by a small rotation vector in the world's frame."""
        return wp.normalize(q + Q(rotation[0], rotation[1], rotation[2], S(0.0)) * q * S(0.5))

    @wp.func
    def inverse_inertia(b: int, bodies: Bodies, v: R3):
        """World inverse inertia times v; nothing while the body is held."""
        result = R3()
        if bodies.w[b] > S(0.0):
            q = bodies.q[b]
            result = wp.quat_rotate(q, bodies.inverse_inertia[b] * wp.quat_rotate_inv(q, v))
        return result

    @wp.func
    def response(b: int, bodies: Bodies, r: R3, n: R3):
        """Inverse mass that an impulse along the unit vector n at offset r meets [1/kg]."""
        rn = wp.cross(r, n)
        return bodies.w[b] + wp.dot(rn, inverse_inertia(b, bodies, rn))

    @wp.func
    def apply_impulse(b: int, bodies: Bodies, r: R3, impulse: R3):
        """Apply a positional impulse [kg m] at offset r from the centre of mass."""
        if bodies.w[b] > S(0.0):
            rotation = inverse_inertia(b, bodies, wp.cross(r, impulse))
            bodies.x[b] = bodies.x[b] + impulse * bodies.w[b]
            bodies.q[b] = turned(bodies.q[b], rotation)

    @wp.func
    def moved(b: int, bodies: Bodies, local: R3):
        """Step of a point of the body (in its frame) since the substep began [m]."""
        now = bodies.x[b] + wp.quat_rotate(bodies.q[b], local)
        return now - (bodies.xp[b] + wp.quat_rotate(bodies.qp[b], local))

    @wp.func
    def spin_down(b: int, omega: R3, bodies: Bodies):
        """Minus the angular acceleration of free rotation, in the body's frame [rad/s^2]."""
        return bodies.inverse_inertia[b] * wp.cross(omega, bodies.inertia[b] * omega)

    @wp.func
    def predict_body(b: int, dt: S, damping_factor: S, gravity: R3, bodies: Bodies):
        x = bodies.x[b]
        q = bodies.q[b]
        bodies.xp[b] = x
        bodies.qp[b] = q
        if bodies.w[b] > S(0.0):
            bodies.x[b] = x + (bodies.v[b] + gravity * dt) * (dt * damping_factor)
            omega = wp.quat_rotate_inv(q, bodies.omega[b])
            # Euler's equations by the midpoint rule: one Euler step would feed energy in
            half = omega - spin_down(b, omega, bodies) * (S(0.5) * dt)
            omega = omega - spin_down(b, half, bodies) * dt
            bodies.q[b] = turned(q, wp.quat_rotate(q, omega) * (dt * damping_factor))

    @wp.func
    def stepped_body(b: int, dt: S, damping_factor: S, gravity: R3, bodies: Bodies):
        """Step of the centre of mass, exact far from the origin (see `table_contact`) [m]."""
        step = R3()
        if bodies.w[b] > S(0.0):
            step = (bodies.v[b] + gravity * dt) * (dt * damping_factor)
        return step + (bodies.x[b] - (bodies.xp[b] + step))

    @wp.func
    def sleep_state(b: int, d: R3, rotation: R3, dt: S, drowsy: S, bodies: Bodies):
        """Whether a body that moved by `d` [m] and turned by `rotation` [rad] is asleep.

        Args:
            drowsy: see `finish_body`
        """
        state = int(AWAKE)
        if bodies.w[b] > S(0.0) and bodies.support[b] >= 3:
            still = wp.length(d) < S(SLEEP_SPEED) * drowsy * dt
            if still and wp.length(rotation) < S(SLEEP_TURN) * drowsy * dt:
                state = wp.where(drowsy > S(1.0), wp.static(STOPS), wp.static(STAYS))
        return state

    @wp.func
    def finish_body(
        b: int, dt: S, damping_factor: S, gravity: R3, fastest: S, drowsy: S, bodies: Bodies
    ):
        """Velocities from the substep; returns the squared step of the centre of mass [m^2], with
        the turning counted at 2 cm from it.

        Args:
            drowsy: factor on the speeds of sleep; above 1 (late in a world of fabrics, where light
                layers under a box give way for ever) a sleeper loses its velocity as well
        """
        d = stepped_body(b, dt, damping_factor, gravity, bodies)
        # the inverse of `turned`, which turns by twice the arc tangent of half the vector's length
        turn = bodies.q[b] * wp.quat_inverse(bodies.qp[b])
        rotation = R3(turn[0], turn[1], turn[2]) * (S(2.0) / turn[3])
        state = sleep_state(b, d, rotation, dt, drowsy, bodies)
        if state != wp.static(AWAKE):
            bodies.x[b] = bodies.xp[b]
            bodies.q[b] = bodies.qp[b]
            if state == wp.static(STOPS):
                d = R3()
                rotation = R3()
        # a calmed body is slowed as a whole
        limit = fastest / wp.max(wp.length(d), fastest)
        bodies.v[b] = d * (limit / dt)
        bodies.omega[b] = rotation * (limit / dt)
        return wp.dot(d, d) + wp.dot(rotation, rotation) * S(4.0e-4)

    return SimpleNamespace(
        turned=turned,
        response=response,
        apply_impulse=apply_impulse,
        moved=moved,
        predict_body=predict_body,
        stepped_body=stepped_body,
        sleep_state=sleep_state,
        finish_body=finish_body,
    )
