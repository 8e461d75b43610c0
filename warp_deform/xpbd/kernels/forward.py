"""The fused forward kernel: one launch runs many substeps, one thread runs L worlds.

Each substep predicts positions, moves the grip, solves distance constraints, contacts and bodies in
Gauss-Seidel order, then resolves the table and derives velocities: XPBD with small steps and one
iteration (Macklin et al., "Small Steps in Physics Simulation", 2019). A world that has come to rest
after its path is frozen while its neighbours go on, so its result is that of running alone.
"""

import functools
from typing import Any

import warp as wp

from ...objects.push import MOST_PUSHES
from ..bodies.rigid_body import rigid
from ..bodies.rigid_body_adjoint import rigid_adjoint
from ..contact.cell_list import cell_list
from ..contact.edge_contact import edge_contact
from ..contact.sphere_contact import sphere_contact
from ..contact.table_contact import table_contact, table_contact_adjoint
from ..lanes.algebra import (  # noqa: F401  (operators are found by name)
    add,
    any_less,
    div,
    kernel_options,
    length,
    less,
    mul,
    nonfinite,
    root,
    select,
    sub,
)
from ..lanes.structures import structures
from ..lanes.tape import BODY_SCALARS, COUNTERS, GRIP_WORDS, tape
from ..springs.internal_friction import internal_friction, internal_friction_adjoint
from .body_solve import body_solve
from .grip import grip, grip_adjoint
from .particle_solve import particle_solve
from .watch import watch

__all__ = ["forward_kernel"]


@functools.cache
def forward_kernel(
    scalar: Any,
    lanes: int,
    with_bodies: bool,
    with_sheets: bool = False,
    with_edges: bool = False,
    taped: bool = False,
) -> Any:
    """The kernel for a precision and a width; launch it with one thread per group.

    `with_bodies` False leaves the code of rigid bodies out, which halves the compile time;
    `with_sheets` False that of triangles, `with_edges` False that of their edges. `taped` leaves a
    tape for the backward sweep (see `tape`) and can continue a launch, to the same bits.
    """
    t = structures(scalar, lanes)
    S, V, V3, R3, L = t.S, t.V, t.V3, t.R3, t.L
    predict, finish = (getattr(table_contact(scalar, lanes), n) for n in ("predict", "finish"))
    list_near = sphere_contact(scalar, lanes).list_near
    cells_ = cell_list(scalar, lanes)
    common_step, moved_since = cells_.common_step, cells_.moved_since
    list_triangles = cells_.list_triangles
    list_edges = edge_contact(scalar, lanes).list_edges
    solve_particles = particle_solve(scalar, lanes, with_sheets, with_edges, taped).solve_particles
    calms = internal_friction(scalar, lanes)
    sleep_speed, calm_particle, damp_spring = (
        getattr(calms, n) for n in ("sleep_speed", "calm_particle", "damp_spring")
    )
    grips_ = grip(scalar, lanes)
    follow_path, take, let_go = grips_.follow_path, grips_.take, grips_.let_go
    body = rigid(scalar, lanes)
    predict_body, finish_body = body.predict_body, body.finish_body
    solve_bodies = body_solve(scalar, lanes, with_sheets, taped).solve_bodies
    record_body = rigid_adjoint(scalar, lanes).record_body
    watch_group = watch(scalar, lanes, with_bodies).watch_group
    record_finish = table_contact_adjoint(scalar, lanes, with_sheets).record_finish
    record_grip = grip_adjoint(scalar, lanes, with_bodies).record_grip
    record_spring = internal_friction_adjoint(scalar, lanes).record_spring
    tapes = tape(scalar, lanes)
    has_room, load_state, save_state = tapes.has_room, tapes.load_state, tapes.save_state
    Settings, Topology, Group, Particles = t.Settings, t.Topology, t.Group, t.Particles
    Springs, Pairs, Shapes, Near = t.Springs, t.Pairs, t.Shapes, t.Near
    Bodies, Contacts, Grips, Watch = t.Bodies, t.Contacts, t.Grips, t.Watch
    Sheets, Cells, Tape = t.Sheets, t.Cells, t.Tape

    @wp.kernel(module="unique", enable_backward=False, module_options=kernel_options(scalar, lanes))
    def forward(
        st: Settings, top: Topology, springs: Springs, pairs: Pairs, shapes: Shapes, group: Group,
        q: Particles, near: Near, bodies: Bodies, contacts: Contacts, grips: Grips, watch: Watch,
        sheets: Sheets, cells: Cells, tape: Tape,
    ):  # fmt: skip
        g = wp.tid()
        k = group.topology[g]
        p0 = group.particle_start[g]
        n = top.particle_count[k]
        radii = top.particle_start[k]
        s0 = top.spring_start[k]
        s1 = top.spring_start[k + 1]
        w0 = g * wp.static(L)
        b0 = group.body_start[g]
        body_count = top.body_count[k]
        near_start = group.near_start[g]
        near_count = int(0)
        zero = V(S(0.0))
        one = V(S(1.0))
        dt = st.dt
        inverse_dt = S(1.0) / dt
        push = st.recovery * dt
        kept = wp.max(zero, one - group.damping[g] * dt)
        gravity = group.gravity[g]
        fall = gravity * dt
        share = kept * dt
        inverse_dt2 = one * (inverse_dt * inverse_dt) / group.stiffness[g]
        table_mu = group.table_friction[g]
        contact_mu = group.contact_friction[g]
        least = group.least_steps[g]
        most = group.most_steps[g]
        on = group.active[g]
        steps = zero
        quiet = zero
        holding = zero
        calm = group.calm_steps[g]
        stale = on
        drift = V3(zero, zero, zero)  # of the frame in which triangles are listed
        fresh = zero  # lanes whose triangles have been listed in this launch
        travel = zero
        clamped = zero
        free_time = zero  # since the launch began or something was let go
        frame = int(0)
        longest_push = int(0)
        begins = bool(True)
        if wp.static(taped):
            begins = tape.resume == 0
        for lane in range(wp.static(L)):
            if wp.static(with_sheets):
                if begins:
                    cells.met[w0 + lane] = 0
            if begins and on[lane] > S(0.0):
                if grips.particle[w0 + lane] >= 0 or grips.body[w0 + lane] >= 0:
                    holding[lane] = S(1.0)
                    take(w0 + lane, lane, p0, b0 + lane * body_count, q, bodies, grips)
                for p in range(wp.static(MOST_PUSHES)):
                    at_push = (w0 + lane) * wp.static(MOST_PUSHES) + p
                    if grips.push[at_push] >= 0:
                        longest_push = wp.max(longest_push, grips.push_steps[at_push])
        # the table hides at once that a particle started under it
        watch_group(g, k, top, springs, shapes, group, q, bodies, watch)
        substep = int(0)
        tops = wp.vec4i()
        if wp.static(taped):
            tops = tape.first[g]
            if not begins:
                (
                    on, steps, quiet, holding, calm, stale, fresh, travel, clamped, free_time,
                    least, drift,
                ) = load_state(g, tape)  # fmt: skip
                at = g * wp.static(COUNTERS)
                substep = tape.counters[at]
                near_count = tape.counters[at + 1]
                longest_push = tape.counters[at + 2]
            if wp.static(not with_sheets):
                for i in range(n):
                    tape.x[tops[0]] = q.v[p0 + i]
                    tops[0] += 1
            tape.steps[g] = -substep
            tape.full[g] = 0
        while substep < st.max_steps and any_less(zero - on, S(0.0)):
            all_on = not any_less(on, S(0.5))
            if st.record_every > 0 and substep % wp.max(st.record_every, 1) == 0:
                for i in range(n):
                    watch.frame_x[frame * st.particle_stride + p0 + i] = q.x[p0 + i]
                if wp.static(with_bodies):
                    for b in range(body_count * wp.static(L)):
                        at = frame * st.body_stride + b0 + b
                        watch.frame_body_x[at] = bodies.x[b0 + b]
                        watch.frame_body_q[at] = bodies.q[b0 + b]
                frame += 1
            # predict
            for i in range(p0, p0 + n):
                predict(i, share, fall, q)
            if wp.static(with_bodies):
                for lane in range(wp.static(L)):
                    if on[lane] > S(0.0):
                        pull = R3(gravity.x[lane], gravity.y[lane], gravity.z[lane])
                        for b in range(body_count):
                            at = b0 + lane * body_count + b
                            predict_body(at, dt, kept[lane], pull, bodies)
            if substep < longest_push:
                for k_push in range(wp.static(L * MOST_PUSHES)):
                    lane = k_push // wp.static(MOST_PUSHES)
                    at_push = w0 * wp.static(MOST_PUSHES) + k_push
                    i = grips.push[at_push]
                    if i >= 0 and substep < grips.push_steps[at_push] and on[lane] > S(0.0):
                        x = q.x[p0 + i]
                        kick = grips.push_acceleration[at_push] * (dt * dt * kept[lane])
                        x.x[lane] = x.x[lane] + kick[0]
                        x.y[lane] = x.y[lane] + kick[1]
                        x.z[lane] = x.z[lane] + kick[2]
                        q.x[p0 + i] = x
            # grips
            if wp.static(taped):
                mark = int(tops[2])
            if any_less(zero - holding, S(0.0)):
                for lane in range(wp.static(L)):
                    if holding[lane] > S(0.0) and on[lane] > S(0.0):
                        w = w0 + lane
                        bl = b0 + lane * body_count
                        radius = S(0.0)
                        if grips.particle[w] >= 0:
                            radius = top.radius[radii + grips.particle[w]]
                        shape = group.shape_start[g] + lane * top.shape_count[k]
                        met = bool(False)
                        if wp.static(with_sheets):
                            met = cells.met[w] > 0
                        if wp.static(taped):
                            tick = grips.tick[w]
                            knot = grips.knot[w]
                            shift = grips.shift[w]
                        goes_on = follow_path(
                            met, w, lane, p0, bl, shape, shape + top.shape_count[k], near_start,
                            near_count, radius, dt, q, pairs, shapes, near, bodies, grips,
                        )  # fmt: skip
                        if wp.static(taped):
                            released = wp.where(goes_on, 0, 1)
                            record_grip(
                                tops[2], w, lane, tick, knot, shift, released, grips, tape
                            )  # fmt: skip
                            tops[2] += wp.static(GRIP_WORDS)
                        if not goes_on:
                            let_go(w, lane, p0, bl, q, bodies, grips)
                            holding[lane] = S(0.0)
                            after = group.calm_after[g]
                            calm[lane] = after[lane]
                            least[lane] = least[lane] + steps[lane]
            # pairs that may touch soon
            if any_less(zero - stale, S(0.0)):
                near_count = list_near(
                    g, p0, near_start, group.near_capacity[g], top.pair_start[k],
                    top.pair_start[k + 1], st.margin, stale, on, q, pairs, near, watch, n,
                )  # fmt: skip
                travel = select(stale, zero, travel)
            if wp.static(with_sheets):
                if sheets.first[k + 1] > sheets.first[k]:
                    common = common_step(p0, n, dt, q)
                    drift = drift + common * on
                    far = moved_since(p0, n, drift, q, cells)
                    for lane in range(wp.static(L)):
                        if on[lane] > S(0.0) and (fresh[lane] < S(0.5) or far[lane] > S(0.0)):
                            anew = fresh[lane] < S(0.5)
                            fresh[lane] = S(1.0)
                            left = list_triangles(
                                g, lane, k, p0, st.margin, anew, drift, common, top, sheets, cells
                            )
                            if wp.static(with_edges):
                                left += list_edges(
                                    g, lane, k, p0, anew, top, sheets, cells
                                )  # fmt: skip
                            over = watch.overflow[g]
                            over[lane] = wp.max(over[lane], S(left))
                            watch.overflow[g] = over
            if wp.static(taped):
                tape.k[tops[2]] = (tops[2] - mark) // wp.static(GRIP_WORDS)
                tops[2] += 1
                listed = int(0)
                if wp.static(with_sheets):
                    for lane in range(wp.static(L)):
                        listed += cells.count[w0 + lane]
                        if wp.static(with_edges):
                            listed += cells.edge_count[w0 + lane]
                triangles = sheets.first[k + 1] - sheets.first[k]
                solid = top.shape_count[k] * (n + triangles) * wp.static(L)
                if not has_room(
                    g, tops, s1 - s0, n, near_count, listed, body_count * wp.static(L), solid, tape
                ):
                    tape.full[g] = 1
                    break
            # constraints
            tops = solve_particles(
                g, n, p0, s0, s1, near_start, near_count, sheets.first[k + 1] - sheets.first[k],
                inverse_dt2, contact_mu, push, holding, on, tops, q, springs, pairs, near, grips,
                sheets, cells, tape,
            )  # fmt: skip
            if wp.static(with_bodies):
                for lane in range(wp.static(L)):
                    if on[lane] > S(0.0):
                        for b in range(body_count):
                            bodies.touching[b0 + lane * body_count + b] = 0
                            bodies.support[b0 + lane * body_count + b] = 0
                        tops = solve_bodies(
                            g, lane, k, push, top, shapes, group, tops, q, bodies, contacts,
                            sheets, cells, tape,
                        )  # fmt: skip
            # table, velocities
            fastest = select(calm, V(st.calm_speed * dt), V(st.max_speed * dt))
            moved2 = zero
            for i in range(n):
                radius = top.radius[radii + i]
                ended2 = zero
                if wp.static(taped):
                    ended2 = record_finish(
                        p0 + i, tops[0], tops[1], radius, inverse_dt, share, fall, table_mu,
                        fastest, all_on, on, q, tape,
                    )  # fmt: skip
                    if wp.static(with_sheets):
                        tops[0] += 3
                    else:
                        tops[0] += 1
                        tops[1] += 1
                else:
                    ended2 = finish(
                        p0 + i, radius, inverse_dt, share, fall, table_mu, fastest, all_on, on, q
                    )  # fmt: skip
                moved2 = wp.max(moved2, ended2)
            unrest2 = moved2
            drowsy = one
            if wp.static(taped):
                sleep = zero
            if wp.static(with_sheets):
                if st.dry > S(0.0) or st.sleep > S(0.0):
                    sleep = sleep_speed(free_time, st.sleep, st.sleep_ramp)
                    drowsy = sleep_speed(free_time, S(1.0), st.sleep_ramp)
                    speed2 = zero
                    for i in range(n):
                        speed2 = wp.max(speed2, calm_particle(p0 + i, st.dry, sleep, on, q))
                    unrest2 = speed2 * (dt * dt)
                if st.viscous > S(0.0):
                    for s in range(s0, s1):
                        if springs.limit[s] > S(0.0):
                            if wp.static(taped):
                                record_spring(s, p0, tops[0], st.viscous, on, q, springs, tape)
                                tops[0] += 1
                            else:
                                damp_spring(s, p0, st.viscous, on, q, springs)
                free_time = (free_time + V(dt)) * (one - holding)
            if wp.static(with_bodies):
                for lane in range(wp.static(L)):
                    if on[lane] > S(0.0):
                        pull = R3(gravity.x[lane], gravity.y[lane], gravity.z[lane])
                        for b in range(body_count):
                            at = b0 + lane * body_count + b
                            if wp.static(taped):
                                tape.k[tops[2]] = record_body(
                                    tops[3], at, dt, kept[lane], pull, drowsy[lane], bodies, tape
                                )  # fmt: skip
                                tops[2] += 1
                                tops[3] += wp.static(BODY_SCALARS - 7)
                            m = finish_body(
                                at, dt, kept[lane], pull, fastest[lane], drowsy[lane], bodies
                            )  # fmt: skip
                            moved2[lane] = wp.max(moved2[lane], m)
                            unrest2[lane] = wp.max(unrest2[lane], m)
            if wp.static(taped):
                tape.v[tops[1]] = on
                tape.v[tops[1] + 1] = fastest
                tape.v[tops[1] + 2] = holding
                tape.v[tops[1] + 3] = sleep
                tops[1] += 4
            moved = root(moved2)
            travel = travel + moved
            # the next substep may move by half as much again before its contacts are solved
            stale = less(V(S(0.5) * st.margin), travel + moved * S(1.5)) * on
            free_run = select(calm, zero, one)
            clamped = clamped + less(V(st.max_speed * dt), moved) * free_run * on
            steps = steps + on
            calm = wp.max(calm - one, zero)
            slow = less(unrest2, V(st.rest_speed * st.rest_speed * dt * dt))
            quiet = (quiet + one) * slow
            rested = less(V(st.rest_steps), quiet + V(S(0.5))) * less(least, steps + V(S(0.5)))
            done = wp.max(rested * (one - holding), less(most, steps + V(S(0.5))))
            substep += 1
            if substep % st.check_every == 0:
                watch_group(g, k, top, springs, shapes, group, q, bodies, watch)
            on = on * (one - done)
        watch_group(g, k, top, springs, shapes, group, q, bodies, watch)
        watch.steps[g] = steps
        watch.clamped[g] = clamped
        ends = bool(True)
        if wp.static(taped):
            save_state(
                g, on, steps, quiet, holding, calm, stale, fresh, travel, clamped, free_time, least,
                drift, tape,
            )  # fmt: skip
            at = g * wp.static(COUNTERS)
            tape.counters[at] = substep
            tape.counters[at + 1] = near_count
            tape.counters[at + 2] = longest_push
            tape.steps[g] = tape.steps[g] + substep
            tape.until[g] = substep
            ends = tape.last > 0
            mark = int(tops[2])
        if wp.static(with_sheets):
            if ends:
                for i in range(p0, p0 + n):
                    cells.xr[i] = cells.xr[i] + drift
        # a world cut off while it held something lets go: nothing is held between launches
        for lane in range(wp.static(L)):
            if ends and holding[lane] > S(0.0):
                if wp.static(taped):
                    tape.k[tops[2]] = lane
                    tape.k[tops[2] + 1] = grips.particle[w0 + lane]
                    if grips.particle[w0 + lane] < 0:
                        tape.k[tops[2] + 1] = -1 - grips.body[w0 + lane]
                    tops[2] += 2
                let_go(w0 + lane, lane, p0, b0 + lane * body_count, q, bodies, grips)
        if wp.static(taped):
            tape.k[tops[2]] = (tops[2] - mark) // 2
            tops[2] += 1
            tape.top[g] = tops

    return forward
