"""The fused forward kernel: one launch runs many substeps, one thread runs L worlds.

Each substep predicts positions, moves the grip, solves distance constraints, contacts and bodies in
Gauss-Seidel order, then resolves the table and derives velocities: XPBD with small steps and one
iteration (Macklin et al., "Small Steps in Physics Simulation", 2019). A world that has come to rest
after its path is frozen while its neighbours go on, so its result is that of running alone.
"""

import functools
from typing import Any

import warp as wp

from ..lanes.algebra import any_less, kernel_options, mul, sub  # noqa: F401  (operators by name)
from ..lanes.group_state import group_state
from ..lanes.tape import tape
from .body_solve import body_solve
from .contact_lists import contact_lists
from .finish import finishes
from .launch_ends import launch_ends
from .lead import leads
from .particle_solve import particle_solve
from .predict import predictions
from .watch import watch

__all__ = ["forward_kernel"]


@functools.cache
def forward_kernel(
    scalar: Any,
    lanes: int,
    with_bodies: bool,
    with_sheets: bool = False,
    with_edges: bool = False,
    with_lines: bool = False,
    taped: bool = False,
) -> Any:
    """The kernel for a precision and a width; launch it with one thread per group, from `first` on.

    `with_bodies` False leaves the code of rigid bodies out, which halves the compile time;
    `with_sheets` False that of triangles, `with_edges` False that of their edges, `with_lines`
    False that of direct solves. `taped` leaves a tape for the backward sweep (see `tape`). With or
    without one, a launch can continue another, to the same bits.
    """
    t = group_state(scalar, lanes)
    S, V = t.S, t.V
    span_of, pace_of = t.span_of, t.pace_of
    ends_ = launch_ends(scalar, lanes, with_bodies, with_sheets, taped)
    begin, record_frame, end = ends_.begin, ends_.record_frame, ends_.end
    predictions_ = predictions(scalar, lanes, with_bodies)
    predict_all, apply_pushes = predictions_.predict_all, predictions_.apply_pushes
    lead_grips = leads(scalar, lanes, with_bodies, with_sheets, taped).lead_grips
    lists_ = contact_lists(scalar, lanes, with_sheets, with_edges)
    list_contacts, count_listed = lists_.list_contacts, lists_.count_listed
    particles_ = particle_solve(scalar, lanes, with_sheets, with_edges, with_lines, taped)
    solve_particles = particles_.solve_particles
    solve_bodies = body_solve(scalar, lanes, with_sheets, taped).solve_bodies
    finishes_ = finishes(scalar, lanes, with_bodies, with_sheets, taped)
    finish_all, count_substep = finishes_.finish_all, finishes_.count_substep
    watch_group = watch(scalar, lanes, with_bodies).watch_group
    tapes = tape(scalar, lanes)
    has_room, load_state, save_state = tapes.has_room, tapes.load_state, tapes.save_state
    Settings, Topology, Group, Particles = t.Settings, t.Topology, t.Group, t.Particles
    Springs, Pairs, Shapes, Near = t.Springs, t.Pairs, t.Shapes, t.Near
    Bodies, Contacts, Grips, Watch = t.Bodies, t.Contacts, t.Grips, t.Watch
    Sheets, Cells, Lines, Tape, Run = t.Sheets, t.Cells, t.Lines, t.Tape, t.Run

    @wp.kernel(module="unique", enable_backward=False, module_options=kernel_options(scalar, lanes))
    def forward(
        st: Settings,
        top: Topology,
        springs: Springs,
        pairs: Pairs,
        shapes: Shapes,
        group: Group,
        particles: Particles,
        near: Near,
        bodies: Bodies,
        contacts: Contacts,
        grips: Grips,
        watch: Watch,
        sheets: Sheets,
        cells: Cells,
        lines: Lines,
        tape: Tape,
        first: int,
    ):
        g = first + wp.tid()
        zero = V(S(0.0))
        at = span_of(g, top, group, sheets)
        pace = pace_of(g, st, group)
        most = group.most_steps[g]
        begins = tape.resume == 0
        run = Run()
        if begins:
            run = begin(at, st, group, particles, bodies, grips, cells)
        # the table hides at once that a particle started under it
        watch_group(at, springs, shapes, group, particles, bodies, watch)
        if not begins:
            run = load_state(g, tape)
        tops = wp.vec4i()
        if wp.static(taped):
            tops = tape.first[g]
            if wp.static(not with_sheets):
                for i in range(at.particles):
                    tape.x[tops[0]] = particles.v[at.p0 + i]
                    tops[0] += 1
            tape.steps[g] = -run.substep
            tape.full[g] = 0
        frame = int(0)
        while run.substep < st.max_steps and any_less(zero - run.on, S(0.0)):
            all_on = not any_less(run.on, S(0.5))
            if st.record_every > 0 and run.substep % wp.max(st.record_every, 1) == 0:
                record_frame(at, frame, st, particles, bodies, watch)
                frame += 1
            # predict
            predict_all(at, pace, run, particles, bodies)
            if run.substep < run.longest_push:
                apply_pushes(at, pace, run, particles, grips)
            # grips
            run, tops = lead_grips(
                at,
                pace,
                run,
                tops,
                top,
                group,
                particles,
                pairs,
                shapes,
                near,
                bodies,
                grips,
                cells,
                tape,
            )
            # contact lists
            run = list_contacts(
                at, pace, run, st, top, group, particles, pairs, near, sheets, cells, watch
            )
            if wp.static(taped):
                if not has_room(at, run, count_listed(at, cells), tops, tape):
                    tape.full[g] = 1
                    break
            # solve
            tops = solve_particles(
                at,
                pace,
                run,
                tops,
                top,
                particles,
                springs,
                lines,
                pairs,
                near,
                grips,
                sheets,
                cells,
                tape,
            )
            if wp.static(with_bodies):
                tops = solve_bodies(
                    at,
                    pace,
                    run,
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
            # finish
            run, tops, moved2, unrest2 = finish_all(
                at, pace, run, all_on, tops, st, top, springs, particles, bodies, tape
            )
            run, done = count_substep(pace, run, most, moved2, unrest2, st)
            if run.substep % st.check_every == 0:
                watch_group(at, springs, shapes, group, particles, bodies, watch)
            run.on = run.on * (V(S(1.0)) - done)
        # record
        watch_group(at, springs, shapes, group, particles, bodies, watch)
        watch.steps[g] = run.steps
        watch.clamped[g] = run.clamped
        if tape.part > 0:
            save_state(g, run, tape)
        if wp.static(taped):
            tape.steps[g] = tape.steps[g] + run.substep
            tape.until[g] = run.substep
        ends = tape.part == 0 or tape.last > 0
        end(at, run, ends, tops, particles, bodies, grips, cells, tape)

    return forward
