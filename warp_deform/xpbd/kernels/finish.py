"""How a substep ends: the table, velocities, what brings fabrics to rest, and what is at rest."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..bodies.rigid_body import rigid_body
from ..bodies.rigid_body_adjoint import rigid_body_adjoint
from ..contact.table_contact import table_contact, table_contact_adjoint
from ..lanes.algebra import add, less, mul, root, select, sub  # noqa: F401  (operators by name)
from ..lanes.group_state import group_state
from ..lanes.tape import BODY_SCALARS
from ..springs.internal_friction import internal_friction, internal_friction_adjoint

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
    finish = table_contact(scalar, lanes).finish
    record_finish = table_contact_adjoint(scalar, lanes, with_sheets).record_finish
    calms = internal_friction(scalar, lanes)
    sleep_speed, calm_particle, damp_spring = (
        getattr(calms, n) for n in ("sleep_speed", "calm_particle", "damp_spring")
    )
    record_spring = internal_friction_adjoint(scalar, lanes).record_spring
    finish_body = rigid_body(scalar, lanes).finish_body
    record_body = rigid_body_adjoint(scalar, lanes).record_body

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
            ended2 = zero
            if wp.static(taped):
                ended2 = record_finish(
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
                if wp.static(with_sheets):
                    tops[0] += 3
                else:
                    tops[0] += 1
                    tops[1] += 1
            else:
                ended2 = finish(
                    at.p0 + i,
                    radius,
                    pace.inverse_dt,
                    pace.damped_dt,
                    pace.fall,
                    pace.table_mu,
                    fastest,
                    all_on,
                    run.on,
                    particles,
                )
            moved2 = wp.max(moved2, ended2)
        unrest2 = moved2
        drowsy = one
        if wp.static(taped):
            sleep = zero
        if wp.static(with_sheets):
            if st.dry > S(0.0) or st.sleep > S(0.0):
                sleep = sleep_speed(run.free_time, st.sleep, st.sleep_ramp)
                drowsy = sleep_speed(run.free_time, S(1.0), st.sleep_ramp)
                speed2 = zero
                for i in range(at.particles):
                    speed2 = wp.max(
                        speed2, calm_particle(at.p0 + i, st.dry, sleep, run.on, particles)
                    )
                unrest2 = speed2 * (dt * dt)
            if st.viscous > S(0.0):
                for s in range(at.s0, at.s1):
                    if springs.limit[s] > S(0.0):
                        if wp.static(taped):
                            record_spring(
                                s, at.p0, tops[0], st.viscous, run.on, particles, springs, tape
                            )
                            tops[0] += 1
                        else:
                            damp_spring(s, at.p0, st.viscous, run.on, particles, springs)
            run.free_time = (run.free_time + V(dt)) * (one - run.holding)
        if wp.static(with_bodies):
            for lane in range(wp.static(L)):
                if run.on[lane] > S(0.0):
                    gravity = R3(pace.gravity.x[lane], pace.gravity.y[lane], pace.gravity.z[lane])
                    for b in range(at.bodies):
                        body = at.b0 + lane * at.bodies + b
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
                        moved2[lane] = wp.max(moved2[lane], m)
                        unrest2[lane] = wp.max(unrest2[lane], m)
        if wp.static(taped):
            tape.v[tops[1]] = run.on
            tape.v[tops[1] + 1] = fastest
            tape.v[tops[1] + 2] = run.holding
            tape.v[tops[1] + 3] = sleep
            tops[1] += 4
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
