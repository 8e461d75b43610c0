"""The fused forward kernel: one launch runs many substeps, one thread runs L worlds.

Each substep predicts positions, moves the grip, solves distance constraints, contacts and bodies in
Gauss-Seidel order, then resolves the table and derives velocities: XPBD with small steps and one
iteration (Macklin et al., "Small Steps in Physics Simulation", 2019). A world that has come to rest
after its path is frozen while its neighbours go on, so its result is that of running alone.
"""

import functools
from typing import Any

import warp as wp

from ..objects.attributes import SpringMode
from ..objects.push import MOST_PUSHES
from .bending import bending
from .body_contact import body_contact
from .box_box import box_box
from .box_particle import box_particle
from .box_table import box_table
from .box_triangle import box_triangle
from .cell_list import cell_list
from .distance import distance
from .edge_contact import edge_contact
from .grip import grip
from .internal_friction import internal_friction
from .lanes import (  # noqa: F401  (operators are found by name)
    KERNEL_OPTIONS,
    add,
    any_less,
    div,
    length,
    less,
    mul,
    nonfinite,
    root,
    select,
    sub,
)
from .rigid import rigid
from .sphere_contact import sphere_contact
from .structures import structures
from .table_contact import table_contact
from .tether import tether
from .triangle_contact import triangle_contact

__all__ = ["forward_kernel"]


@functools.cache
def forward_kernel(
    scalar: Any,
    lanes: int,
    with_bodies: bool,
    with_sheets: bool = False,
    with_edges: bool = False,
) -> Any:
    """The kernel for a precision and a width; launch it with one thread per group.

    `with_bodies` False leaves the code of rigid bodies out, which halves the compile time;
    `with_sheets` False that of triangles, `with_edges` False that of their edges.
    """
    t = structures(scalar, lanes)
    S, V, V3, R3, L = t.S, t.V, t.V3, t.R3, t.L
    predict, finish = (getattr(table_contact(scalar, lanes), n) for n in ("predict", "finish"))
    project_distance = distance(scalar, lanes, with_sheets).project_distance
    project_bend = bending(scalar, lanes).project_bend
    contact = sphere_contact(scalar, lanes)
    list_near, project_contact = contact.list_near, contact.project_contact
    cells_ = cell_list(scalar, lanes)
    common_step, moved_since = cells_.common_step, cells_.moved_since
    list_triangles = cells_.list_triangles
    project_triangles = triangle_contact(scalar, lanes).project_triangles
    edges_ = edge_contact(scalar, lanes)
    list_edges, project_edges = edges_.list_edges, edges_.project_edges
    calms = internal_friction(scalar, lanes)
    sleep_speed, calm_particle, damp_spring = (
        getattr(calms, n) for n in ("sleep_speed", "calm_particle", "damp_spring")
    )
    project_tether = tether(scalar, lanes).project_tether
    grips_ = grip(scalar, lanes)
    follow_path, take, let_go = grips_.follow_path, grips_.take, grips_.let_go
    body = rigid(scalar, lanes)
    predict_body, finish_body = body.predict_body, body.finish_body
    list_table = box_table(scalar, lanes).list_table
    project_box_particle = box_particle(scalar, lanes).project_box_particle
    project_box_triangles = box_triangle(scalar, lanes).project_box_triangles
    list_boxes = box_box(scalar, lanes).list_boxes
    bodies_ = body_contact(scalar, lanes)
    begin_body, solve_contacts, end_body = (
        getattr(bodies_, n) for n in ("begin_body", "solve_contacts", "end_body")
    )
    Settings, Topology, Group, Particles = t.Settings, t.Topology, t.Group, t.Particles
    Springs, Pairs, Shapes, Near = t.Springs, t.Pairs, t.Shapes, t.Near
    Bodies, Contacts, Grips, Watch = t.Bodies, t.Contacts, t.Grips, t.Watch
    Sheets, Cells = t.Sheets, t.Cells

    @wp.func
    def solve_bodies(
        g: int, lane: int, k: int, push: S, top: Topology, shapes: Shapes, group: Group,
        q: Particles, bodies: Bodies, contacts: Contacts, sheets: Sheets, cells: Cells,
    ):  # fmt: skip
        """Contacts of one lane's bodies with particles, each other and the table."""
        p0 = group.particle_start[g]
        count = top.body_count[k]
        b0 = group.body_start[g] + lane * count
        first = group.shape_start[g] + lane * top.shape_count[k]
        last = first + top.shape_count[k]
        mv = group.contact_friction[g]
        mu = mv[lane]
        tv = group.table_friction[g]
        radii = top.particle_start[k]
        for shape in range(first, last):
            b = b0 + shapes.body[shape]
            far = wp.length(shapes.half[shape])
            center = bodies.x[b] + wp.quat_rotate(bodies.q[b], shapes.center[shape])
            thickest = S(0.0)
            for i in range(top.particle_count[k]):
                radius = top.radius[radii + i]
                thickest = wp.max(thickest, radius)
                x = q.x[p0 + i]
                d = R3(x.x[lane], x.y[lane], x.z[lane]) - center
                if wp.dot(d, d) < (far + radius) * (far + radius):
                    project_box_particle(
                        p0 + i, lane, radius, shape, b, mu, push, q, shapes, bodies
                    )
            if wp.static(with_sheets):
                project_box_triangles(
                    lane, k, p0, radii, shape, b, far + thickest, mu, push, top, shapes, bodies,
                    sheets, cells,
                )  # fmt: skip
        for b in range(b0, b0 + count):
            begin_body(b, bodies)
        start = group.contact_start[g]
        c = int(start)
        for sa in range(first, last):
            for sb in range(sa + 1, last):
                a = b0 + shapes.body[sa]
                b = b0 + shapes.body[sb]
                if a != b and bodies.w[a] + bodies.w[b] > S(0.0):
                    pair_mu = mu * wp.min(shapes.friction[sa], shapes.friction[sb])
                    c = list_boxes(c, sa, a, sb, b, pair_mu, push, shapes, bodies, contacts)
        for b in range(count):
            if bodies.w[b0 + b] > S(0.0):
                c = list_table(c, b0 + b, b, first, last, tv[lane], push, shapes, bodies, contacts)
        solve_contacts(start, c, bodies, contacts)
        for b in range(b0, b0 + count):
            end_body(b, bodies)

    @wp.func
    def watch_group(
        g: int, p0: int, n: int, s0: int, s1: int, b0: int, body_count: int, springs: Springs,
        q: Particles, bodies: Bodies, watch: Watch,
    ):  # fmt: skip
        """Worst values of the guards, once every `check_every` substeps."""
        zero = V(S(0.0))
        bad = watch.nonfinite[g]
        lowest = V(S(1.0e9))
        for i in range(p0, p0 + n):
            x = q.x[i]
            bad = wp.max(bad, nonfinite(x.x + x.y + x.z))
            lowest = wp.min(lowest, x.z)
        if wp.static(with_bodies):
            for lane in range(wp.static(L)):
                for b in range(b0 + lane * body_count, b0 + (lane + 1) * body_count):
                    sum = bodies.x[b] + bodies.omega[b]
                    if not wp.isfinite(sum[0] + sum[1] + sum[2]):
                        bad[lane] = S(1.0)
        watch.nonfinite[g] = bad
        watch.depth[g] = wp.max(watch.depth[g], wp.max(zero - lowest, zero))
        stretch = watch.stretch[g]
        for s in range(s0, s1):
            if springs.watched[s] > 0:
                ij = springs.ij[s]
                l = length(q.x[p0 + ij[0]] - q.x[p0 + ij[1]])
                stretch = wp.max(stretch, l * (S(1.0) / springs.length[s]))
        watch.stretch[g] = stretch

    @wp.kernel(module="unique", enable_backward=False, module_options=dict(KERNEL_OPTIONS))
    def forward(
        st: Settings, top: Topology, springs: Springs, pairs: Pairs, shapes: Shapes, group: Group,
        q: Particles, near: Near, bodies: Bodies, contacts: Contacts, grips: Grips, watch: Watch,
        sheets: Sheets, cells: Cells,
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
        for lane in range(wp.static(L)):
            if wp.static(with_sheets):
                cells.met[w0 + lane] = 0
            if on[lane] > S(0.0):
                if grips.particle[w0 + lane] >= 0 or grips.body[w0 + lane] >= 0:
                    holding[lane] = S(1.0)
                    take(w0 + lane, lane, p0, b0 + lane * body_count, q, bodies, grips)
                for p in range(wp.static(MOST_PUSHES)):
                    at_push = (w0 + lane) * wp.static(MOST_PUSHES) + p
                    if grips.push[at_push] >= 0:
                        longest_push = wp.max(longest_push, grips.push_steps[at_push])
        # the table hides at once that a particle started under it
        watch_group(g, p0, n, s0, s1, b0, body_count, springs, q, bodies, watch)
        substep = int(0)
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
                predict(i, dt, kept, fall, q)
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
                        if not follow_path(
                            met, w, lane, p0, bl, shape, shape + top.shape_count[k], near_start,
                            near_count, radius, dt, q, pairs, shapes, near, bodies, grips,
                        ):  # fmt: skip
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
            # constraints
            # always in the same order: sweeping backwards in every other substep makes tight heaps
            # crawl for ever, and shells jitter
            for s in range(s0, s1):
                if springs.mode[s] == wp.static(int(SpringMode.BEND)):
                    project_bend(s, p0, inverse_dt2, q, springs)
                else:
                    project_distance(s, p0, inverse_dt2, q, springs)
            if wp.static(with_sheets):
                if any_less(zero - holding, S(0.0)):
                    held = q.x[p0]
                    for lane in range(wp.static(L)):
                        i = grips.particle[w0 + lane]
                        if i >= 0:
                            x = q.x[p0 + i]
                            held.x[lane] = x.x[lane]
                            held.y[lane] = x.y[lane]
                            held.z[lane] = x.z[lane]
                    for i in range(n):
                        project_tether(p0 + i, holding, held, q)
            for c in range(near_start, near_start + near_count):
                project_contact(c, p0, contact_mu, push, q, pairs, near)
            if wp.static(with_sheets):
                if sheets.first[k + 1] > sheets.first[k]:
                    for lane in range(wp.static(L)):
                        if on[lane] > S(0.0):
                            hit = project_triangles(
                                g, lane, p0, grips.particle[w0 + lane], contact_mu[lane], push,
                                sheets, cells,
                            )  # fmt: skip
                            cells.met[w0 + lane] = wp.where(hit, 1, 0)
                            if wp.static(with_edges):
                                project_edges(g, lane, p0, push, sheets, cells)
            if wp.static(with_bodies):
                for lane in range(wp.static(L)):
                    if on[lane] > S(0.0):
                        for b in range(body_count):
                            bodies.touching[b0 + lane * body_count + b] = 0
                            bodies.support[b0 + lane * body_count + b] = 0
                        solve_bodies(
                            g, lane, k, push, top, shapes, group, q, bodies, contacts, sheets,
                            cells,
                        )  # fmt: skip
            # table, velocities
            fastest = select(calm, V(st.calm_speed * dt), V(st.max_speed * dt))
            moved2 = zero
            for i in range(n):
                radius = top.radius[radii + i]
                moved2 = wp.max(
                    moved2, finish(p0 + i, radius, inverse_dt, table_mu, fastest, all_on, on, q)
                )
            unrest2 = moved2
            drowsy = one
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
                            damp_spring(s, p0, st.viscous, on, q, springs)
                free_time = (free_time + V(dt)) * (one - holding)
            if wp.static(with_bodies):
                for lane in range(wp.static(L)):
                    if on[lane] > S(0.0):
                        for b in range(body_count):
                            at = b0 + lane * body_count + b
                            m = finish_body(at, dt, fastest[lane], drowsy[lane], bodies)
                            moved2[lane] = wp.max(moved2[lane], m)
                            unrest2[lane] = wp.max(unrest2[lane], m)
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
                watch_group(g, p0, n, s0, s1, b0, body_count, springs, q, bodies, watch)
            on = on * (one - done)
        watch_group(g, p0, n, s0, s1, b0, body_count, springs, q, bodies, watch)
        if wp.static(with_sheets):
            for i in range(p0, p0 + n):
                cells.xr[i] = cells.xr[i] + drift
        watch.steps[g] = steps
        watch.clamped[g] = clamped
        # a world cut off while it held something lets go: nothing is held between launches
        for lane in range(wp.static(L)):
            if holding[lane] > S(0.0):
                let_go(w0 + lane, lane, p0, b0 + lane * body_count, q, bodies, grips)

    return forward
