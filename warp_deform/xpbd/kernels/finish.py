"""How a substep ends: the table, velocities, viscosity and sleep of fabrics, what is at rest."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..bodies.rigid_body import rigid_body
from ..bodies.rigid_body_adjoint import rigid_body_adjoint
from ..contact.table_contact import table_contact
from ..lanes.algebra import add, dot, less, mul, root, select, sub  # noqa: F401
from ..lanes.group_state import group_state
from ..lanes.tape import BODY_SCALARS
from ..springs.sleep import sleep
from ..springs.viscosity import viscosity, viscosity_adjoint

__all__ = ["finishes"]


@functools.cache
def finishes(
    scalar: Any, lanes: int, with_bodies: bool, with_sheets: bool, taped: bool
) -> SimpleNamespace:
    """`finish_all` ends a substep for a group and returns its `Run`, the tops of the tape, and two
    squared lengths by lane [m^2]: of the longest step, and of the longest that is no creeping.
    `count_substep` counts it, and says which lists are stale and which worlds have come to rest.
    """
    t = group_state(scalar, lanes)
    S, V, R3, L = t.S, t.V, t.R3, t.L
    Span, Pace, Run, Settings, Topology = t.Span, t.Pace, t.Run, t.Settings, t.Topology
    Particles, Springs, Bodies, Tape = t.Particles, t.Springs, t.Bodies, t.Tape
    finish = table_contact(scalar, lanes, with_sheets, taped).finish
    damp_fabrics = viscosity(scalar, lanes).damp_fabrics
    record_damping = viscosity_adjoint(scalar, lanes).record_damping
    rest_fabrics = sleep(scalar, lanes, taped).rest_fabrics
    finish_body = rigid_body(scalar, lanes).finish_body
    record_body = rigid_body_adjoint(scalar, lanes).record_body

    @wp.func
    def drowsiness(free: V, ramp: S):
        """Factor on the sleep speed of boxes so long after a release."""
        late = wp.min(wp.max(free - V(S(1.0)), V(S(0.0))), V(S(1.0)))
        return V(S(1.0)) + late * (ramp - S(1.0))

    @wp.func
    def finish_all(
        at: Span,
        pace: Pace,
        run: Run,
        all_on: bool,
        tops: wp.vec4i,
        st: Settings,
        top: Topology,
        springs: Springs,
        particles: Particles,
        bodies: Bodies,
        tape: Tape,
    ):
        zero = V(S(0.0))
        one = V(S(1.0))
        dt = pace.dt
        fastest = select(run.calm, V(st.calm_speed * dt), V(st.max_speed * dt))
        moved2 = zero
        for i in range(at.particles):
            radius = top.radius[at.radii + i]
            ended2 = finish(
                at.p0 + i,
                tops[0],
                tops[1],
                radius,
                pace.inverse_dt,
                pace.damped_dt,
                pace.fall,
                pace.table_mu,
                fastest,
                all_on,
                run.on,
                particles,
                tape,
            )
            if wp.static(taped and with_sheets):
                tops[0] += 3
            elif wp.static(taped):
                tops[0] += 1
                tops[1] += 1
            moved2 = wp.max(moved2, ended2)
        unrest2 = zero
        drowsy = one
        stirred = zero
        if wp.static(with_sheets):
            drowsy = drowsiness(run.free_time, st.sleep_ramp)
            if st.viscous > S(0.0) and run.substep % st.damp_every == 0:
                if wp.static(taped):
                    record_damping(at, tops[0], st.viscous, run.on, top, particles, springs, tape)
                    tops[0] += 2 * at.particles
                else:
                    damp_fabrics(at, st.viscous, run.on, top, particles, springs)
            run.free_time = (run.free_time + V(dt)) * (one - run.holding)
        if wp.static(with_bodies):
            for lane in range(wp.static(L)):
                if run.on[lane] > S(0.0):
                    gravity = R3(pace.gravity.x[lane], pace.gravity.y[lane], pace.gravity.z[lane])
                    for b in range(at.bodies):
                        body = at.b0 + lane * at.bodies + b
                        if wp.static(with_sheets):
                            if bodies.touching[body] > 0:
                                if wp.length(bodies.v[body]) > st.rest_speed:
                                    stirred[lane] = S(1.0)
                        if wp.static(taped):
                            tape.k[tops[2]] = record_body(
                                tops[3],
                                body,
                                dt,
                                pace.damping_factor[lane],
                                gravity,
                                drowsy[lane],
                                bodies,
                                tape,
                            )
                            tops[2] += 1
                            tops[3] += wp.static(BODY_SCALARS - 7)
                        m = finish_body(
                            body,
                            dt,
                            pace.damping_factor[lane],
                            gravity,
                            fastest[lane],
                            drowsy[lane],
                            bodies,
                        )
                        unrest2[lane] = wp.max(unrest2[lane], m)
        slow2 = moved2
        moved2 = wp.max(moved2, unrest2)
        if wp.static(with_sheets):
            if st.sleep > S(0.0):
                rest_fabrics(at, pace, st, stirred, run.on, tops[1], top, particles, springs, tape)
                if wp.static(taped):
                    tops[1] += at.particles
                slow2 = zero
                for i in range(at.p0, at.p0 + at.particles):
                    slow2 = wp.max(slow2, dot(particles.v[i], particles.v[i]))
                slow2 = slow2 * run.on * (dt * dt)
        unrest2 = wp.max(unrest2, slow2)
        if wp.static(taped):
            tape.v[tops[1]] = run.on
            tape.v[tops[1] + 1] = fastest
            tape.v[tops[1] + 2] = run.holding
            tops[1] += 3
        return run, tops, moved2, unrest2

    @wp.func
    def count_substep(pace: Pace, run: Run, most: V, moved2: V, unrest2: V, st: Settings):
        zero = V(S(0.0))
        one = V(S(1.0))
        dt = pace.dt
        moved = root(moved2)
        run.travel = run.travel + moved
        # the next substep may move by half as much again before its contacts are solved
        run.stale = less(V(S(0.5) * st.margin), run.travel + moved * S(1.5)) * run.on
        free_run = select(run.calm, zero, one)
        run.clamped = run.clamped + less(V(st.max_speed * dt), moved) * free_run * run.on
        run.steps = run.steps + run.on
        run.calm = wp.max(run.calm - one, zero)
        slow = less(unrest2, V(st.rest_speed * st.rest_speed * dt * dt))
        run.quiet = (run.quiet + one) * slow
        rested = less(V(st.rest_steps), run.quiet + V(S(0.5)))
        rested = rested * less(run.least, run.steps + V(S(0.5)))
        done = wp.max(rested * (one - run.holding), less(most, run.steps + V(S(0.5))))
        run.substep += 1
        return run, done

    return SimpleNamespace(finish_all=finish_all, count_substep=count_substep)
