"""Contacts of a world's rigid bodies: with particles, triangles, each other and the table."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..bodies.body_contact import body_contact
from ..bodies.body_pairs import body_pairs
from ..bodies.body_visits import body_visits
from ..bodies.box_particle import box_particle
from ..bodies.box_particle_adjoint import box_particle_adjoint
from ..bodies.box_triangle import box_triangle
from ..bodies.box_triangle_adjoint import box_triangle_adjoint
from ..lanes.group_state import group_state
from ..lanes.tape import BODY_WORDS, BOX_PARTICLE_SCALARS, BOX_TRIANGLE_SCALARS, tape

__all__ = ["body_solve"]


@functools.cache
def body_solve(scalar: Any, lanes: int, with_sheets: bool, taped: bool = False) -> SimpleNamespace:
    """`solve_bodies(...)`: the contacts of all bodies, lane by lane and in a fixed order.

    `taped`, each that acts with a particle or a triangle leaves what its adjoint needs on the tape
    from `tops` on, and bodies their poses before contacts with each other. Returns the tops after
    that.
    """
    t = group_state(scalar, lanes)
    S, R3, L = t.S, t.R3, t.L
    Span, Pace, Run = t.Span, t.Pace, t.Run
    Topology, Shapes, Group, Particles = t.Topology, t.Shapes, t.Group, t.Particles
    Bodies, Contacts, Sheets, Cells = t.Bodies, t.Contacts, t.Sheets, t.Cells
    Tape = t.Tape
    project_box_particle = box_particle(scalar, lanes).project_box_particle
    project_box_triangles = box_triangle(scalar, lanes).project_box_triangles
    list_pairs = body_pairs(scalar, lanes).list_pairs
    record_box_particle = box_particle_adjoint(scalar, lanes).record_box_particle
    record_box_triangles = box_triangle_adjoint(scalar, lanes).record_box_triangles
    record_pose = tape(scalar, lanes).record_pose
    bodies_ = body_contact(scalar, lanes)
    end_body = bodies_.end_body
    solve_contacts = body_visits(scalar, lanes).solve_contacts

    @wp.func
    def meet_particles(
        lane: int,
        at: Span,
        tops: wp.vec4i,
        shape: int,
        number: int,
        b: int,
        mu: S,
        max_recovery: S,
        top: Topology,
        shapes: Shapes,
        particles: Particles,
        bodies: Bodies,
        tape: Tape,
    ):
        """All particles of a lane against one box, which is shape `number` of its world."""
        far = wp.length(shapes.half[shape])
        center = bodies.x[b] + wp.quat_rotate(bodies.q[b], shapes.center[shape])
        for i in range(at.particles):
            radius = top.radius[at.radii + i]
            x = particles.x[at.p0 + i]
            d = R3(x.x[lane], x.y[lane], x.z[lane]) - center
            if wp.dot(d, d) < (far + radius) * (far + radius):
                if wp.static(taped):
                    if record_box_particle(
                        tops[3],
                        at.p0 + i,
                        lane,
                        radius,
                        shape,
                        b,
                        mu,
                        max_recovery,
                        particles,
                        shapes,
                        bodies,
                        tape,
                    ):
                        tape.k[tops[2]] = i
                        tape.k[tops[2] + 1] = number
                        tops[2] += wp.static(BODY_WORDS)
                        tops[3] += wp.static(BOX_PARTICLE_SCALARS)
                else:
                    project_box_particle(
                        at.p0 + i,
                        lane,
                        radius,
                        shape,
                        b,
                        mu,
                        max_recovery,
                        particles,
                        shapes,
                        bodies,
                    )
        return tops

    @wp.func
    def solve_lane(
        lane: int,
        at: Span,
        pace: Pace,
        tops: wp.vec4i,
        top: Topology,
        shapes: Shapes,
        group: Group,
        particles: Particles,
        bodies: Bodies,
        contacts: Contacts,
        sheets: Sheets,
        cells: Cells,
        tape: Tape,
    ):
        """Contacts of one lane's bodies with particles, each other and the table."""
        g = at.g
        k = at.k
        max_recovery = pace.max_recovery
        p0 = at.p0
        count = at.bodies
        b0 = at.b0 + lane * count
        first = at.shape0 + lane * at.shapes
        last = first + at.shapes
        mu = pace.contact_mu[lane]
        radii = at.radii
        for b in range(b0, b0 + count):
            bodies.touching[b] = 0
            bodies.support[b] = 0
        thickest = S(0.0)
        for i in range(at.particles):
            thickest = wp.max(thickest, top.radius[radii + i])
        mark = int(tops[2])
        for shape in range(first, last):
            b = b0 + shapes.body[shape]
            tops = meet_particles(
                lane,
                at,
                tops,
                shape,
                shape - first,
                b,
                mu,
                max_recovery,
                top,
                shapes,
                particles,
                bodies,
                tape,
            )
            far = wp.length(shapes.half[shape])
            if wp.static(with_sheets and taped):
                touched = record_box_triangles(
                    tops[2],
                    tops[3],
                    lane,
                    k,
                    p0,
                    radii,
                    shape,
                    shape - first,
                    b,
                    far + thickest,
                    mu,
                    max_recovery,
                    top,
                    shapes,
                    bodies,
                    sheets,
                    cells,
                    tape,
                )
                tops[2] += wp.static(BODY_WORDS) * touched
                tops[3] += wp.static(BOX_TRIANGLE_SCALARS) * touched
            elif wp.static(with_sheets):
                project_box_triangles(
                    lane,
                    k,
                    p0,
                    radii,
                    shape,
                    b,
                    far + thickest,
                    mu,
                    max_recovery,
                    top,
                    shapes,
                    bodies,
                    sheets,
                    cells,
                )
            if wp.static(with_sheets):
                if at.triangles > 0:
                    # what a fabric over the box has pressed into those below is not left as it is:
                    # it would come back as speed
                    touching = bodies.touching[b]
                    support = bodies.support[b]
                    tops = meet_particles(
                        lane,
                        at,
                        tops,
                        shape,
                        shape - first,
                        b,
                        mu,
                        max_recovery,
                        top,
                        shapes,
                        particles,
                        bodies,
                        tape,
                    )
                    bodies.touching[b] = touching
                    bodies.support[b] = support
        if wp.static(taped):
            tape.k[tops[2]] = (tops[2] - mark) // wp.static(BODY_WORDS)
            tops[2] += 1
            for b in range(b0, b0 + count):
                record_pose(tops[3], bodies.x[b], bodies.q[b], tape)
                tops[3] += 7
        end = list_pairs(g, lane, k, max_recovery, top, shapes, group, bodies, contacts)
        solve_contacts(group.contact_start[g], end, bodies, contacts)
        for b in range(b0, b0 + count):
            end_body(b, bodies)
        return tops

    @wp.func
    def solve_bodies(
        at: Span,
        pace: Pace,
        run: Run,
        tops: wp.vec4i,
        top: Topology,
        shapes: Shapes,
        group: Group,
        particles: Particles,
        bodies: Bodies,
        contacts: Contacts,
        sheets: Sheets,
        cells: Cells,
        tape: Tape,
    ):
        for lane in range(wp.static(L)):
            if run.on[lane] > S(0.0):
                tops = solve_lane(
                    lane,
                    at,
                    pace,
                    tops,
                    top,
                    shapes,
                    group,
                    particles,
                    bodies,
                    contacts,
                    sheets,
                    cells,
                    tape,
                )
        return tops

    return SimpleNamespace(solve_bodies=solve_bodies)
