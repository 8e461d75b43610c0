"""Adjoint of the contacts of a world's rigid bodies, see `body_solve`."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..bodies.body_contact import PASSES, VISIT, body_contact
from ..bodies.body_contact_adjoint import body_contact_adjoint
from ..bodies.body_pairs import body_pairs
from ..bodies.box_box_adjoint import box_box_adjoint
from ..bodies.box_particle_adjoint import box_particle_adjoint
from ..bodies.box_table import box_table
from ..bodies.box_triangle_adjoint import box_triangle_adjoint
from ..bodies.rigid_body_adjoint import rigid_adjoint
from ..lanes.structures import structures
from ..lanes.tape import BODY_WORDS, BOX_PARTICLE_SCALARS, BOX_TRIANGLE_SCALARS
from .grip import grip_adjoint

__all__ = ["body_adjoint"]

POSE = 7


@functools.cache
def body_adjoint(scalar: Any, lanes: int, with_sheets: bool) -> SimpleNamespace:
    """`sweep_body_pairs(lane, ...)`: contacts of the bodies of one lane with each other and the
    table; `sweep_body_contacts` those with particles and triangles, which came before.
    """
    t = structures(scalar, lanes)
    S, R3 = t.S, t.R3
    Topology, Shapes, Group, Sheets = t.Topology, t.Shapes, t.Group, t.Sheets
    Bodies, Contacts, Tape = t.Bodies, t.Contacts, t.Tape
    Adjoint, BodyAdjoint = t.Adjoint, t.BodyAdjoint
    corner = box_table(scalar, lanes, True).corner
    list_pairs = body_pairs(scalar, lanes, True).list_pairs
    sweep_boxes = box_box_adjoint(scalar, lanes).sweep_boxes
    solve_contacts = body_contact(scalar, lanes, True).solve_contacts
    contact_ = body_contact_adjoint(scalar, lanes)
    sweep_end_body, sweep_visits, sweep_listed, sweep_spread, clear_contacts = (
        getattr(contact_, name)
        for name in (
            "sweep_end_body", "sweep_visits", "sweep_listed", "sweep_spread", "clear_contacts"
        )
    )  # fmt: skip
    sweep_box_particle = box_particle_adjoint(scalar, lanes).sweep_box_particle
    sweep_box_triangle = box_triangle_adjoint(scalar, lanes).sweep_box_triangle
    poses = rigid_adjoint(scalar, lanes)
    position, quaternion = poses.position, poses.quaternion
    turned_by = grip_adjoint(scalar, lanes, False).turned_by

    @wp.func
    def itself(x: S) -> S:
        return x

    @wp.func
    def sweep_body_pairs(
        g: int, lane: int, k: int, at: int, push: S, counts: int, top: Topology, shapes: Shapes,
        group: Group, bodies: Bodies, contacts: Contacts, tape: Tape, ba: BodyAdjoint,
        adj: Adjoint,
    ):  # fmt: skip
        """Poses before these contacts are on the tape from `at` on; returns the derivatives by
        friction of the table and of contacts.
        """
        # Warp puts functions that take gradients last: what calls them has to be such a one, too
        one = wp.grad(itself)(push)
        count = top.body_count[k]
        b0 = group.body_start[g] + lane * count
        for b in range(count):
            bodies.x[b0 + b] = position(at + b * wp.static(POSE), tape)
            bodies.q[b0 + b] = quaternion(at + b * wp.static(POSE) + 3, tape)
        start = group.contact_start[g]
        end = list_pairs(g, lane, k, push, top, shapes, group, bodies, contacts)
        passes = solve_contacts(start, end, bodies, contacts)
        clear_contacts(start, end, ba)
        for b in range(b0, b0 + count):
            sweep_end_body(b, bodies.q[b], bodies, ba)
        log = start * wp.static(PASSES * VISIT)
        sweep_visits(start, end, passes, log, lane, counts, bodies, contacts, ba, adj)
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
                ga, gb, gn = sweep_listed(i, pa, pb, push, bodies, contacts, ba)
                sweep_boxes(a, b, code, ga, gb, gn, shapes, bodies, ba)
                rub = wp.min(shapes.friction[code[0]], shapes.friction[code[1]])
                by_contact += ba.mu[i] * rub
            else:
                foot = R3(pb[0], pb[1], S(0.0))
                ga, gb, gn = sweep_listed(i, foot, pb, push, bodies, contacts, ba)
                gp = gb + R3(ga[0], ga[1], S(0.0))
                ba.x[b] = ba.x[b] + gp
                local = corner(code[1], code[2], shapes)
                ba.q[b] = ba.q[b] + turned_by(local, bodies.q[b], gp)
                by_table += ba.mu[i] * shapes.friction[code[1]]
        for b in range(b0, b0 + count):
            sweep_spread(b, bodies, ba)
        return by_table, by_contact

    @wp.func
    def sweep_body_contacts(
        g: int, lane: int, k: int, word: int, scalar: int, finished: int, push: S, counts: int,
        top: Topology, shapes: Shapes, group: Group, bodies: Bodies, sheets: Sheets, tape: Tape,
        ba: BodyAdjoint, adj: Adjoint,
    ):  # fmt: skip
        """Pops contacts from both stacks; returns their tops and the derivative by friction."""
        p0 = group.particle_start[g]
        b0 = group.body_start[g] + lane * top.body_count[k]
        mv = group.contact_friction[g]
        radii = top.particle_start[k]
        one = wp.grad(itself)(push)
        by_mu = one - one
        tk = word - 1
        ts = int(scalar)
        for _ in range(tape.k[word - 1]):
            tk -= wp.static(BODY_WORDS)
            who = tape.k[tk]
            shape = group.shape_start[g] + lane * top.shape_count[k] + tape.k[tk + 1]
            b = b0 + shapes.body[shape]
            if who >= 0:
                ts -= wp.static(BOX_PARTICLE_SCALARS)
                by_mu += sweep_box_particle(
                    ts, p0 + who, lane, top.radius[radii + who], shape, b, mv[lane], push, counts,
                    shapes, bodies, tape, ba, adj,
                )  # fmt: skip
            elif wp.static(with_sheets):
                ts -= wp.static(BOX_TRIANGLE_SCALARS)
                by_mu += sweep_box_triangle(
                    ts, -1 - who, finished, lane, p0, radii, shape, b, mv[lane], push, counts, top,
                    shapes, bodies, sheets, tape, ba, adj,
                )  # fmt: skip
        return tk, ts, by_mu

    return SimpleNamespace(
        sweep_body_pairs=sweep_body_pairs, sweep_body_contacts=sweep_body_contacts
    )
