"""The backward kernel: one launch sweeps all substeps of a tape in reverse, in the same lanes.

The sweep meets the constraints in exactly the opposite order of the forward kernel, pops each one's
inputs from the tape, takes the branch that the forward pass took on these inputs, and adds the
product of the loss's derivatives with the constraint's Jacobian. Contact lists play no part in it:
what touched is on the tape. Source: Griewank, Walther, "Evaluating Derivatives", 2008, chapter 3.
"""

import functools
from typing import Any

import warp as wp

from ...objects.attributes import SpringMode
from ...objects.push import MOST_PUSHES
from ..bodies.rigid_body_adjoint import rigid_adjoint
from ..contact.edge_contact_adjoint import edge_contact_adjoint
from ..contact.sphere_contact import sphere_contact_adjoint
from ..contact.table_contact import table_contact_adjoint
from ..contact.triangle_contact_adjoint import triangle_contact_adjoint
from ..lanes.algebra import add, any_less, div, kernel_options, less, mul, select, sub  # noqa: F401
from ..lanes.structures import structures
from ..lanes.tape import BODY_SCALARS, GRIP_WORDS, TRIANGLE_SCALARS, TRIANGLE_WORDS, Kind, tape
from ..springs.bending import bending_adjoint
from ..springs.distance import distance_adjoint
from ..springs.internal_friction import internal_friction_adjoint
from ..springs.tether import tether_adjoint
from .body_adjoint import body_adjoint
from .grip import grip_adjoint

__all__ = ["adjoint_kernel"]


@functools.cache
def adjoint_kernel(
    scalar: Any,
    lanes: int,
    with_bodies: bool,
    with_sheets: bool = False,
    with_edges: bool = False,
) -> Any:
    """The kernel for a precision and a width, with the variants of `forward_kernel`.

    `Adjoint` holds the derivatives by the state after the tape's last substep and leaves with those
    by the state before its first; derivatives by parameters are added to. `Adjoint.w` takes the
    inverse masses of the state likewise. With `leave`, the prediction of the first substep is left
    to the sweep of the tape before (`pending`), which finds the velocity without a tape.
    """
    t = structures(scalar, lanes)
    S, V, V3, L = t.S, t.V, t.V3, t.L
    sweep_distance = distance_adjoint(scalar, lanes, with_sheets).sweep_distance
    sweep_bend = bending_adjoint(scalar, lanes).sweep_bend
    sweep_contact = sphere_contact_adjoint(scalar, lanes).sweep_contact
    table_ = table_contact_adjoint(scalar, lanes, with_sheets)
    sweep_finish, sweep_predict = table_.sweep_finish, table_.sweep_predict
    stepped = table_.stepped
    sweep_tether = tether_adjoint(scalar, lanes).sweep_tether
    sweep_triangle = triangle_contact_adjoint(scalar, lanes).sweep_triangle
    sweep_edge = edge_contact_adjoint(scalar, lanes).sweep_edge
    sweep_spring = internal_friction_adjoint(scalar, lanes).sweep_spring
    grips_ = grip_adjoint(scalar, lanes, with_bodies)
    sweep_grip, held_again = grips_.sweep_grip, grips_.held_again
    rigid_ = rigid_adjoint(scalar, lanes)
    load_body, sweep_finish_body = rigid_.load_body, rigid_.sweep_finish_body
    sweep_predict_body = rigid_.sweep_predict_body
    solid_ = body_adjoint(scalar, lanes, with_sheets)
    sweep_body_pairs, sweep_body_contacts = solid_.sweep_body_pairs, solid_.sweep_body_contacts
    R3, Q = t.R3, t.Q
    Shapes, Bodies, Contacts, BodyAdjoint = t.Shapes, t.Bodies, t.Contacts, t.BodyAdjoint
    Settings, Topology, Springs, Pairs = t.Settings, t.Topology, t.Springs, t.Pairs
    Group, Grips, Tape, Adjoint = t.Group, t.Grips, t.Tape, t.Adjoint
    Particles, Sheets = t.Particles, t.Sheets
    KINDS = len(Kind)
    BYTES = 3 * lanes * (4 if scalar is wp.float32 else 8)
    fetch_ahead = tape(scalar, lanes).fetch_ahead

    @wp.func
    def count(kind: int, on: V, amount: int, adj: Adjoint):
        adj.fired[kind] = adj.fired[kind] + on * S(amount)

    @wp.func
    def nonzero(x: R3, q: Q):
        far = wp.abs(x[0]) + wp.abs(x[1]) + wp.abs(x[2])
        return far + wp.abs(q[0]) + wp.abs(q[1]) + wp.abs(q[2]) + wp.abs(q[3]) > S(0.0)

    @wp.kernel(module="unique", enable_backward=False, module_options=kernel_options(scalar, lanes))
    def sweep(
        st: Settings, top: Topology, springs: Springs, pairs: Pairs, shapes: Shapes, group: Group,
        q: Particles, bodies: Bodies, contacts: Contacts, grips: Grips, sheets: Sheets, tape: Tape,
        adj: Adjoint, ba: BodyAdjoint,
    ):  # fmt: skip
        g = wp.tid()
        k = group.topology[g]
        p0 = group.particle_start[g]
        n = top.particle_count[k]
        radii = top.particle_start[k]
        s0 = top.spring_start[k]
        s1 = top.spring_start[k + 1]
        w0 = g * wp.static(L)
        counts = g * wp.static(KINDS)
        b0 = group.body_start[g]
        body_count = top.body_count[k]
        zero = V(S(0.0))
        one = V(S(1.0))
        dt = st.dt
        inverse_dt = S(1.0) / dt
        push = st.recovery * dt
        kept = wp.max(zero, one - group.damping[g] * dt)
        fall = group.gravity[g] * dt
        inverse_dt2 = one * (inverse_dt * inverse_dt) / group.stiffness[g]
        table_mu = group.table_friction[g]
        contact_mu = group.contact_friction[g]
        by_kept = adj.damping[g]
        by_inverse_dt2 = adj.stiffness[g]
        by_table = adj.table_friction[g]
        by_contact = adj.contact_friction[g]
        bends = int(0)
        stretches = int(0)
        damped = int(0)
        for s in range(s0, s1):
            if springs.mode[s] == wp.static(int(SpringMode.BEND)):
                bends += 1
            elif springs.mode[s] == wp.static(int(SpringMode.EQUAL)):
                stretches += 1
            if springs.limit[s] > S(0.0):
                damped += 1
        longest_push = int(0)
        for p in range(wp.static(L * MOST_PUSHES)):
            if grips.push[w0 * wp.static(MOST_PUSHES) + p] >= 0:
                longest_push = wp.max(
                    longest_push, grips.push_steps[w0 * wp.static(MOST_PUSHES) + p]
                )
        tops = tape.top[g]
        tx = int(tops[0])
        tv = int(tops[1])
        tk = int(tops[2])
        ts = int(tops[3])
        # what the end of the launch let go is held before
        tk -= 1
        for _ in range(tape.k[tk]):
            tk -= 2
            lane = tape.k[tk]
            held_again(lane, tape.k[tk + 1], p0, b0 + lane * body_count, adj, ba)
        last = int(tx)
        for back in range(tape.steps[g]):
            substep = tape.until[g] - 1 - back
            # what the sweep will pop two substeps on, were they as long as the last one
            ahead = 2 * (last - tx)
            last = int(tx)
            tv -= 4
            on = tape.v[tv]
            fastest = tape.v[tv + 1]
            count(counts + wp.static(int(Kind.STRETCH)), on, stretches, adj)
            count(counts + wp.static(int(Kind.BEND)), on, bends, adj)
            matters = zero
            if wp.static(with_bodies):
                for r in range(wp.static(L)):
                    lane = wp.static(L) - 1 - r
                    if on[lane] > S(0.0):
                        for rb in range(body_count):
                            b = b0 + lane * body_count + body_count - 1 - rb
                            tk -= 1
                            ts -= wp.static(BODY_SCALARS - 7)
                            load_body(ts, b, bodies, tape)
                            sweep_finish_body(
                                b, lane, tape.k[tk], dt, fastest[lane], counts, bodies, ba, adj
                            )  # fmt: skip
                            if tape.k[tk] == 0 or nonzero(ba.x[b], ba.q[b]):
                                matters[lane] = S(1.0)
            # velocities, table
            if wp.static(with_sheets):
                if st.viscous > S(0.0):
                    count(counts + wp.static(int(Kind.VISCOSITY)), on, damped, adj)
                    for r in range(s1 - s0):
                        s = s1 - 1 - r
                        if springs.limit[s] > S(0.0):
                            tx -= 1
                            sweep_spring(s, p0, tape.x[tx], st.viscous, on, springs, adj)
            all_on = not any_less(on, S(0.5))
            again = back > 0 or adj.pending[g] > 0
            if wp.static(with_sheets):
                tx -= 3 * n
            else:
                tx -= n
                tv -= n
            for i in range(n):
                d = tape.x[tx]
                z = zero
                sleep = zero
                if wp.static(with_sheets):
                    fetch_ahead(tape.x, tx + 3 * i - ahead, wp.static(3 * BYTES))
                    x = tape.x[tx + 3 * i]
                    d = stepped(
                        x, tape.x[tx + 3 * i + 1], adj.w[p0 + i], tape.x[tx + 3 * i + 2], kept * dt,
                        fall,
                    )  # fmt: skip
                    z = x.z
                    sleep = tape.v[tv + 3]
                else:
                    fetch_ahead(tape.x, tx + i - ahead, wp.static(BYTES))
                    d = tape.x[tx + i]
                    z = tape.v[tv + i]
                by_mu, by_share = sweep_finish(
                    p0 + i, d, z, top.radius[radii + i], inverse_dt, table_mu, fastest, on, all_on,
                    again, dt, kept, fall, st.dry, sleep, counts, adj,
                )  # fmt: skip
                by_table = by_table + by_mu
                by_kept = by_kept + by_share
            finished = int(tx)
            tv_end = int(tv)
            # contacts of bodies
            if wp.static(with_bodies):
                for r in range(wp.static(L)):
                    lane = wp.static(L) - 1 - r
                    if on[lane] > S(0.0):
                        ts -= 7 * body_count
                        # where all bodies sleep on, nothing depends on what contacts would do
                        if matters[lane] > S(0.0):
                            by_floor, by_pairs = sweep_body_pairs(
                                g, lane, k, ts, push, counts, top, shapes, group, bodies, contacts,
                                tape, ba, adj,
                            )  # fmt: skip
                            by_table[lane] = by_table[lane] + by_floor
                            by_contact[lane] = by_contact[lane] + by_pairs
                        tk, ts, by_mu_solid = sweep_body_contacts(
                            g, lane, k, tk, ts, finished, push, counts, top, shapes, group, bodies,
                            sheets, tape, ba, adj,
                        )  # fmt: skip
                        by_contact[lane] = by_contact[lane] + by_mu_solid
            # contacts of fabrics
            if wp.static(with_sheets):
                if sheets.first[k + 1] > sheets.first[k]:
                    for r in range(wp.static(L)):
                        lane = wp.static(L) - 1 - r
                        if on[lane] > S(0.0):
                            if wp.static(with_edges):
                                tk -= 1
                                for _ in range(tape.k[tk]):
                                    tk -= wp.static(TRIANGLE_WORDS)
                                    ts -= wp.static(TRIANGLE_SCALARS)
                                    sweep_edge(
                                        tk, ts, finished, lane, p0, push, counts, sheets, tape, adj
                                    )
                            tk -= 1
                            for _ in range(tape.k[tk]):
                                tk -= wp.static(TRIANGLE_WORDS)
                                ts -= wp.static(TRIANGLE_SCALARS)
                                by_contact[lane] = by_contact[lane] + sweep_triangle(
                                    tk, ts, finished, lane, p0, contact_mu[lane], push, counts,
                                    sheets, tape, adj,
                                )  # fmt: skip
            # contacts
            tk -= 1
            for _ in range(tape.k[tk]):
                tk -= 1
                tv -= 1
                tx -= 2
                fetch_ahead(tape.x, tx - ahead, wp.static(2 * BYTES))
                by_contact = by_contact + sweep_contact(
                    tape.k[tk], p0, tape.x[tx], tape.x[tx + 1], tape.v[tv], contact_mu, push,
                    pairs, counts, on, adj,
                )  # fmt: skip
            # tethers
            if wp.static(with_sheets):
                holding = tape.v[tv_end + 2]
                if any_less(zero - holding, S(0.0)):
                    tk -= wp.static(L)
                    at = int(tk)
                    tk -= 1
                    by_held = V3(zero, zero, zero)
                    for _ in range(tape.k[tk]):
                        tk -= 1
                        tx -= 1
                        by_held = by_held + sweep_tether(
                            p0 + tape.k[tk], tape.x[tx], holding, counts, on, q, adj
                        )
                    for lane in range(wp.static(L)):
                        if tape.k[at + lane] >= 0:
                            gx = adj.x[p0 + tape.k[at + lane]]
                            gx.x[lane] = gx.x[lane] + by_held.x[lane]
                            gx.y[lane] = gx.y[lane] + by_held.y[lane]
                            gx.z[lane] = gx.z[lane] + by_held.z[lane]
                            adj.x[p0 + tape.k[at + lane]] = gx
            # springs
            tk -= 1
            left = tape.k[tk]
            for r in range(s1 - s0):
                s = s1 - 1 - r
                mode = springs.mode[s]
                if mode == wp.static(int(SpringMode.BEND)):
                    tx -= 1
                    by_inverse_dt2 = by_inverse_dt2 + sweep_bend(
                        s, p0, tape.x[tx], inverse_dt2, springs, adj
                    )
                else:
                    acted = mode == wp.static(int(SpringMode.EQUAL))
                    if not acted and left > 0:
                        if tape.k[tk - 1] == s:
                            acted = True
                            tk -= 1
                            left -= 1
                    if acted:
                        tx -= 1
                        fetch_ahead(tape.x, tx - ahead, wp.static(BYTES))
                        by_inverse_dt2 = by_inverse_dt2 + sweep_distance(
                            s, p0, tape.x[tx], inverse_dt2, springs, counts, on, adj
                        )
            # grips
            tk -= 1
            for _ in range(tape.k[tk]):
                tk -= wp.static(GRIP_WORDS)
                sweep_grip(tk, w0, p0, b0, body_count, dt, counts, grips, tape, adj, ba)
            # pushes
            for k_push in range(wp.where(substep < longest_push, wp.static(L * MOST_PUSHES), 0)):
                lane = k_push // wp.static(MOST_PUSHES)
                at_push = w0 * wp.static(MOST_PUSHES) + k_push
                i = grips.push[at_push]
                if i >= 0 and substep < grips.push_steps[at_push] and on[lane] > S(0.0):
                    gx = adj.x[p0 + i]
                    kick = grips.push_acceleration[at_push] * (dt * dt)
                    by_kept[lane] = by_kept[lane] + (
                        gx.x[lane] * kick[0] + gx.y[lane] * kick[1] + gx.z[lane] * kick[2]
                    )
            if wp.static(with_bodies):
                gravity = group.gravity[g]
                for lane in range(wp.static(L)):
                    if on[lane] > S(0.0):
                        pull = R3(gravity.x[lane], gravity.y[lane], gravity.z[lane])
                        for b in range(b0 + lane * body_count, b0 + (lane + 1) * body_count):
                            by_kept[lane] = by_kept[lane] + sweep_predict_body(
                                b, dt, kept[lane], pull, bodies, ba
                            )
            # prediction; without fabrics it is taken back with the substep before
            if wp.static(with_sheets):
                for i in range(n):
                    by_kept = by_kept + sweep_predict(
                        p0 + i, tape.x[finished + 3 * i + 2], dt, kept, fall, adj
                    )
        if wp.static(not with_sheets):
            if tape.steps[g] > 0:
                adj.pending[g] = adj.leave
            if tape.steps[g] > 0 and adj.leave == 0:
                for i in range(n):
                    by_kept = by_kept + sweep_predict(
                        p0 + i, tape.x[tx - n + i], dt, kept, fall, adj
                    )
        adj.damping[g] = by_kept
        adj.table_friction[g] = by_table
        adj.contact_friction[g] = by_contact
        adj.stiffness[g] = by_inverse_dt2

    return sweep
