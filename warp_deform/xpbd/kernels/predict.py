"""How a substep begins: everything moves on as if nothing were in its way."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ...objects.push import MOST_PUSHES
from ..bodies.rigid_body import rigid_body
from ..contact.table_contact import table_contact
from ..lanes.group_state import group_state

__all__ = ["predictions"]


@functools.cache
def predictions(scalar: Any, lanes: int, with_bodies: bool) -> SimpleNamespace:
    """`predict_all` moves a group's particles and bodies by their velocities, air and gravity;
    `apply_pushes` adds the pushes that act in the substep.
    """
    t = group_state(scalar, lanes)
    S, R3, L = t.S, t.R3, t.L
    Span, Pace, Run = t.Span, t.Pace, t.Run
    Particles, Bodies, Grips = t.Particles, t.Bodies, t.Grips
    predict = table_contact(scalar, lanes).predict
    predict_body = rigid_body(scalar, lanes).predict_body

    @wp.func
    def predict_all(at: Span, pace: Pace, run: Run, particles: Particles, bodies: Bodies):
        for i in range(at.p0, at.p0 + at.particles):
            predict(i, pace.damped_dt, pace.fall, particles)
        if wp.static(with_bodies):
            for lane in range(wp.static(L)):
                if run.on[lane] > S(0.0):
                    gravity = R3(pace.gravity.x[lane], pace.gravity.y[lane], pace.gravity.z[lane])
                    for b in range(at.bodies):
                        predict_body(
                            at.b0 + lane * at.bodies + b,
                            pace.dt,
                            pace.damping_factor[lane],
                            gravity,
                            bodies,
                        )

    @wp.func
    def apply_pushes(at: Span, pace: Pace, run: Run, particles: Particles, grips: Grips):
        for p in range(wp.static(L * MOST_PUSHES)):
            lane = p // wp.static(MOST_PUSHES)
            slot = at.world0 * wp.static(MOST_PUSHES) + p
            i = grips.push[slot]
            if i >= 0 and run.substep < grips.push_steps[slot] and run.on[lane] > S(0.0):
                x = particles.x[at.p0 + i]
                kick = grips.push_acceleration[slot] * (
                    pace.dt * pace.dt * pace.damping_factor[lane]
                )
                x.x[lane] = x.x[lane] + kick[0]
                x.y[lane] = x.y[lane] + kick[1]
                x.z[lane] = x.z[lane] + kick[2]
                particles.x[at.p0 + i] = x

    return SimpleNamespace(predict_all=predict_all, apply_pushes=apply_pushes)
