"""The phases of rigid bodies taken back: how they end, their contacts, how they begin."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..bodies.body_contact_adjoint import body_contact_adjoint
from ..bodies.body_pairs import body_pairs
from ..bodies.body_visits import VISITS, body_visits
from ..bodies.body_visits_adjoint import body_visits_adjoint
from ..bodies.box_box_adjoint import box_box_adjoint
from ..bodies.box_particle_adjoint import box_particle_adjoint
from ..bodies.box_table import box_table_adjoint
from ..bodies.box_triangle_adjoint import box_triangle_adjoint
from ..bodies.rigid_body_adjoint import rigid_body_adjoint
from ..lanes.algebra import add  # noqa: F401  (operators are found by name)
from ..lanes.sweep_state import sweep_state
from ..lanes.tape import BODY_SCALARS, BODY_WORDS, BOX_PARTICLE_SCALARS, BOX_TRIANGLE_SCALARS, tape

__all__ = ["adjoint_bodies"]

POSE = 7


@functools.cache
def adjoint_bodies(scalar: Any, lanes: int, with_sheets: bool) -> SimpleNamespace:
    """`sweep_finished_bodies`, `sweep_bodies` and `sweep_predicted_bodies` of a group."""
    t = sweep_state(scalar, lanes)
    S, V, R3, Q, L = t.S, t.V, t.R3, t.Q, t.L
    Span, Pace, Substep, By = t.Span, t.Pace, t.Substep, t.By
    Topology, Shapes, Group, Sheets = t.Topology, t.Shapes, t.Group, t.Sheets
    Bodies, Contacts, Tape = t.Bodies, t.Contacts, t.Tape
    Adjoint, BodyAdjoint = t.Adjoint, t.BodyAdjoint
    list_pairs = body_pairs(scalar, lanes, True).list_pairs
    sweep_boxes = box_box_adjoint(scalar, lanes).sweep_boxes
    sweep_table = box_table_adjoint(scalar, lanes).sweep_table
    solve_contacts = body_visits(scalar, lanes, True).solve_contacts
    contact_ = body_contact_adjoint(scalar, lanes)
    sweep_end_body, sweep_listed, sweep_spread, clear_contacts = (
        getattr(contact_, name)
        for name in ("sweep_end_body", "sweep_listed", "sweep_spread", "clear_contacts")
    )
    visits_ = body_visits_adjoint(scalar, lanes)
    sweep_visits, count_contacts = visits_.sweep_visits, visits_.count_contacts
    sweep_box_particle = box_particle_adjoint(scalar, lanes).sweep_box_particle
    sweep_box_triangle = box_triangle_adjoint(scalar, lanes).sweep_box_triangle
    poses = rigid_body_adjoint(scalar, lanes)
    position, quaternion = tape(scalar, lanes).position, tape(scalar, lanes).quaternion
    load_body, sweep_finish_body = poses.load_body, poses.sweep_finish_body
    sweep_predict_body = poses.sweep_predict_body

    @wp.func
    def itself(x: S) -> S:
        return x

    @wp.func
    def sweep_body_pairs(
        lane: int,
        at: Span,
        pace: Pace,
        counts: int,
        before: int,
        top: Topology,
        shapes: Shapes,
        group: Group,
        bodies: Bodies,
        contacts: Contacts,
        tape: Tape,
        ba: BodyAdjoint,
        adj: Adjoint,
    ):
        """Contacts of one lane's bodies with each other and the table.

        Poses `before` these contacts are on the tape; returns the derivatives by friction of the
        table and of contacts.
        """
        g = at.g
        max_recovery = pace.max_recovery
        # Warp puts functions that take gradients last: what calls them has to be such a one, too
        one = wp.grad(itself)(max_recovery)
        count = at.bodies
        b0 = at.b0 + lane * count
        for b in range(count):
            bodies.x[b0 + b] = position(before + b * wp.static(POSE), tape)
            bodies.q[b0 + b] = quaternion(before + b * wp.static(POSE) + 3, tape)
        start = group.contact_start[g]
        end = list_pairs(g, lane, at.k, max_recovery, top, shapes, group, bodies, contacts)
        visits = solve_contacts(start, end, bodies, contacts)
        clear_contacts(start, end, ba)
        for b in range(b0, b0 + count):
            sweep_end_body(b, bodies.q[b], bodies, ba)
        count_contacts(start, end, lane, counts, contacts, adj)
        log = start * wp.static(VISITS)
        sweep_visits(log, log + visits, bodies, contacts, ba)
        by_table = one - one
        by_contact = S(0.0)
        for r in range(end - start):
            i = end - 1 - r
            a = contacts.a[i]
            b = contacts.b[i]
            code = contacts.code[i]
            pb = bodies.x[b] + contacts.rb[i]
            if a >= 0:
                pa = bodies.x[a] + contacts.ra[i]
                ga, gb, gn = sweep_listed(i, pa, pb, max_recovery, bodies, contacts, ba)
                if b0 + shapes.body[code[0]] == a:
                    sweep_boxes(a, b, code, ga, gb, gn, shapes, bodies, ba)
                else:
                    sweep_boxes(b, a, code, gb, ga, -gn, shapes, bodies, ba)
                rub = wp.min(shapes.friction[code[0]], shapes.friction[code[1]])
                by_contact += ba.mu[i] * rub
            else:
                foot = R3(pb[0], pb[1], S(0.0))
                ga, gb, gn = sweep_listed(i, foot, pb, max_recovery, bodies, contacts, ba)
                sweep_table(b, code, ga, gb, shapes, bodies, ba)
                by_table += ba.mu[i] * shapes.friction[code[1]]
        for b in range(b0, b0 + count):
            sweep_spread(b, bodies, ba)
        return by_table, by_contact

    @wp.func
    def sweep_body_contacts(
        lane: int,
        at: Span,
        pace: Pace,
        now: Substep,
        tops: wp.vec4i,
        top: Topology,
        shapes: Shapes,
        bodies: Bodies,
        sheets: Sheets,
        tape: Tape,
        ba: BodyAdjoint,
        adj: Adjoint,
    ):
        """Contacts of one lane's bodies with particles and triangles; returns the tops of the tape
        and the derivative by friction.
        """
        max_recovery = pace.max_recovery
        counts = now.counts
        p0 = at.p0
        b0 = at.b0 + lane * at.bodies
        mu = pace.contact_mu[lane]
        radii = at.radii
        one = wp.grad(itself)(max_recovery)
        by_mu = one - one
        tk = tops[2] - 1
        ts = int(tops[3])
        for _ in range(tape.k[tops[2] - 1]):
            tk -= wp.static(BODY_WORDS)
            who = tape.k[tk]
            shape = at.shape0 + lane * at.shapes + tape.k[tk + 1]
            b = b0 + shapes.body[shape]
            if who >= 0:
                ts -= wp.static(BOX_PARTICLE_SCALARS)
                by_mu += sweep_box_particle(
                    ts,
                    p0 + who,
                    lane,
                    top.radius[radii + who],
                    shape,
                    b,
                    mu,
                    max_recovery,
                    counts,
                    shapes,
                    bodies,
                    tape,
                    ba,
                    adj,
                )
            elif wp.static(with_sheets):
                ts -= wp.static(BOX_TRIANGLE_SCALARS)
                by_mu += sweep_box_triangle(
                    ts,
                    -1 - who,
                    now.finished,
                    lane,
                    p0,
                    radii,
                    shape,
                    b,
                    mu,
                    max_recovery,
                    counts,
                    top,
                    shapes,
                    bodies,
                    sheets,
                    tape,
                    ba,
                    adj,
                )
        return wp.vec4i(tops[0], tops[1], tk, ts), by_mu

    @wp.func
    def nonzero(x: R3, q: Q):
        far = wp.abs(x[0]) + wp.abs(x[1]) + wp.abs(x[2])
        return far + wp.abs(q[0]) + wp.abs(q[1]) + wp.abs(q[2]) + wp.abs(q[3]) > S(0.0)

    @wp.func
    def sweep_finished_bodies(
        at: Span,
        pace: Pace,
        now: Substep,
        tops: wp.vec4i,
        bodies: Bodies,
        tape: Tape,
        ba: BodyAdjoint,
        adj: Adjoint,
    ):
        """Returns the tops of the tape, and in which lanes anything depends on the contacts."""
        unit = wp.grad(itself)(pace.max_recovery)  # as above
        matters = V(S(0.0))
        for r in range(wp.static(L)):
            lane = wp.static(L) - 1 - r
            if now.on[lane] * unit > S(0.0):
                for rb in range(at.bodies):
                    b = at.b0 + lane * at.bodies + at.bodies - 1 - rb
                    tops[2] -= 1
                    tops[3] -= wp.static(BODY_SCALARS - 7)
                    load_body(tops[3], b, bodies, tape)
                    asleep = tape.k[tops[2]]
                    sweep_finish_body(
                        b, lane, asleep, pace.dt, now.fastest[lane], now.counts, bodies, ba, adj
                    )
                    if asleep == 0 or nonzero(ba.x[b], ba.q[b]):
                        matters[lane] = S(1.0)
        return tops, matters

    @wp.func
    def sweep_bodies(
        at: Span,
        pace: Pace,
        now: Substep,
        matters: V,
        by: By,
        tops: wp.vec4i,
        top: Topology,
        shapes: Shapes,
        group: Group,
        bodies: Bodies,
        contacts: Contacts,
        sheets: Sheets,
        tape: Tape,
        ba: BodyAdjoint,
        adj: Adjoint,
    ):
        unit = wp.grad(itself)(pace.max_recovery)  # as above
        by_table = by.table
        by_contact = by.contact
        for r in range(wp.static(L)):
            lane = wp.static(L) - 1 - r
            if now.on[lane] * unit > S(0.0):
                tops[3] -= 7 * at.bodies
                # where all bodies sleep on, nothing depends on what contacts would do
                if matters[lane] > S(0.0):
                    by_floor, by_pairs = sweep_body_pairs(
                        lane,
                        at,
                        pace,
                        now.counts,
                        tops[3],
                        top,
                        shapes,
                        group,
                        bodies,
                        contacts,
                        tape,
                        ba,
                        adj,
                    )
                    by_table[lane] = by_table[lane] + by_floor
                    by_contact[lane] = by_contact[lane] + by_pairs
                tops, by_mu = sweep_body_contacts(
                    lane, at, pace, now, tops, top, shapes, bodies, sheets, tape, ba, adj
                )
                by_contact[lane] = by_contact[lane] + by_mu
        by.table = by_table
        by.contact = by_contact
        return by, tops

    @wp.func
    def sweep_predicted_bodies(
        at: Span, pace: Pace, now: Substep, by: By, bodies: Bodies, ba: BodyAdjoint
    ):
        unit = wp.grad(itself)(pace.max_recovery)  # as above
        by_damping = by.damping_factor
        for lane in range(wp.static(L)):
            if now.on[lane] * unit > S(0.0):
                gravity = R3(pace.gravity.x[lane], pace.gravity.y[lane], pace.gravity.z[lane])
                for b in range(at.b0 + lane * at.bodies, at.b0 + (lane + 1) * at.bodies):
                    by_damping[lane] = by_damping[lane] + sweep_predict_body(
                        b, pace.dt, pace.damping_factor[lane], gravity, bodies, ba
                    )
        by.damping_factor = by_damping
        return by

    return SimpleNamespace(
        sweep_finished_bodies=sweep_finished_bodies,
        sweep_bodies=sweep_bodies,
        sweep_predicted_bodies=sweep_predicted_bodies,
    )
