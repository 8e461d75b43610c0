"""The backward kernel: one launch sweeps all substeps of a tape in reverse, in the same lanes.

The sweep meets the constraints in exactly the opposite order of the forward kernel, pops each one's
inputs from the tape, takes the branch that the forward pass took on these inputs, and adds the
product of the loss's derivatives with the constraint's Jacobian. Contact lists play no part in it:
what touched is on the tape. The phases stand in `adjoint_phases`, `adjoint_sheets` and
`adjoint_bodies`. Source: Griewank, Walther, "Evaluating Derivatives", 2008, chapter 3.
"""

import functools
from typing import Any

import warp as wp

from ..lanes.algebra import add, kernel_options, mul, sub  # noqa: F401  (operators by name)
from .adjoint_bodies import adjoint_bodies
from .adjoint_phases import adjoint_phases
from .adjoint_sheets import adjoint_sheets
from .grip_adjoint import grip_adjoint

__all__ = ["adjoint_kernel"]


@functools.cache
def adjoint_kernel(
    scalar: Any,
    lanes: int,
    with_bodies: bool,
    with_sheets: bool = False,
    with_edges: bool = False,
    with_lines: bool = False,
) -> Any:
    """The kernel for a precision and a width, with the variants of `forward_kernel`.

    `Adjoint` holds the derivatives by the state after the tape's last substep and leaves with those
    by the state before its first; derivatives by parameters are added to. `Adjoint.w` takes the
    inverse masses of the state likewise. With `leave`, the prediction of the first substep is left
    to the sweep of the tape before (`pending`), which finds the velocity without a tape.
    """
    t = adjoint_phases(scalar, lanes, with_bodies, with_sheets, with_lines)
    S, V, span_of, pace_of = t.S, t.V, t.span_of, t.pace_of
    held_again = grip_adjoint(scalar, lanes, with_bodies).held_again
    solids = adjoint_bodies(scalar, lanes, with_sheets)
    sweep_finished_bodies, sweep_bodies = solids.sweep_finished_bodies, solids.sweep_bodies
    sweep_predicted_bodies = solids.sweep_predicted_bodies
    look_ahead, open_substep = t.look_ahead, t.open_substep
    sweep_finishes, sweep_contacts = t.sweep_finishes, t.sweep_contacts
    sweep_springs, sweep_grips = t.sweep_springs, t.sweep_grips
    sweep_pushes, sweep_predictions = t.sweep_pushes, t.sweep_predictions
    sheets_ = adjoint_sheets(scalar, lanes, with_edges)
    sweep_sleep, sweep_viscosity = sheets_.sweep_sleep, sheets_.sweep_viscosity
    sweep_tethers, sweep_fabrics = sheets_.sweep_tethers, sheets_.sweep_fabrics
    Settings, Topology, Pairs, Shapes = t.Settings, t.Topology, t.Pairs, t.Shapes
    Springs, Lines = t.Springs, t.Lines
    Group, Particles, Bodies, Contacts, Grips = t.Group, t.Particles, t.Bodies, t.Contacts, t.Grips
    Sheets, Tape, Adjoint, BodyAdjoint, By = t.Sheets, t.Tape, t.Adjoint, t.BodyAdjoint, t.By

    options = kernel_options(scalar, lanes)

    @wp.kernel(module="unique", enable_backward=False, module_options=options)
    def sweep(
        st: Settings,
        top: Topology,
        springs: Springs,
        pairs: Pairs,
        shapes: Shapes,
        group: Group,
        particles: Particles,
        bodies: Bodies,
        contacts: Contacts,
        grips: Grips,
        sheets: Sheets,
        lines: Lines,
        tape: Tape,
        adj: Adjoint,
        ba: BodyAdjoint,
        first: int,
    ):
        g = first + wp.tid()
        at = span_of(g, top, group, sheets)
        pace = pace_of(g, st, group)
        always = look_ahead(at, top, springs, grips)
        by = By()
        by.damping_factor = adj.damping[g]
        by.inverse_dt2 = adj.stiffness[g]
        by.table = adj.table_friction[g]
        by.contact = adj.contact_friction[g]
        tops = tape.top[g]
        # what the end of the launch let go is held before
        tops[2] -= 1
        for _ in range(tape.k[tops[2]]):
            tops[2] -= 2
            lane = tape.k[tops[2]]
            held_again(lane, tape.k[tops[2] + 1], at.p0, at.b0 + lane * at.bodies, adj, ba)
        last = int(tops[0])
        for back in range(tape.steps[g]):
            # what the sweep will pop two substeps on, were they as long as the last one
            ahead = 2 * (last - tops[0])
            last = int(tops[0])
            substep = tape.until[g] - 1 - back
            now, tops = open_substep(at, always, substep, ahead, tops, tape, adj)
            # finish
            matters = V(S(0.0))
            if wp.static(with_bodies):
                tops, matters = sweep_finished_bodies(at, pace, now, tops, bodies, tape, ba, adj)
            if wp.static(with_sheets):
                tops = sweep_sleep(at, st, now, tops, tape, adj)
                tops = sweep_viscosity(at, st, now, always, tops, top, springs, tape, adj)
            again = back > 0 or adj.pending[g] > 0
            by, tops = sweep_finishes(at, pace, now, again, by, tops, top, tape, adj)
            now.finished = tops[0]
            # solve
            if wp.static(with_bodies):
                by, tops = sweep_bodies(
                    at,
                    pace,
                    now,
                    matters,
                    by,
                    tops,
                    top,
                    shapes,
                    group,
                    bodies,
                    contacts,
                    sheets,
                    tape,
                    ba,
                    adj,
                )
            if wp.static(with_sheets):
                by, tops = sweep_fabrics(at, pace, now, by, tops, top, sheets, tape, adj)
            by, tops = sweep_contacts(at, pace, now, by, tops, pairs, tape, adj)
            if wp.static(with_sheets):
                tops = sweep_tethers(at, now, tops, particles, tape, adj)
            by, tops = sweep_springs(at, pace, now, by, tops, springs, lines, tape, adj)
            # grips
            tops = sweep_grips(at, pace, tops, grips, tape, adj, ba)
            # predict
            if substep < always.longest_push:
                by = sweep_pushes(at, pace, now, by, grips, adj)
            if wp.static(with_bodies):
                by = sweep_predicted_bodies(at, pace, now, by, bodies, ba)
            # without fabrics the prediction is taken back with the substep before
            if wp.static(with_sheets):
                by = sweep_predictions(at, pace, now.finished + 2, 3, by, tape, adj)
        if wp.static(not with_sheets):
            if tape.steps[g] > 0:
                adj.pending[g] = adj.leave
            if tape.steps[g] > 0 and adj.leave == 0:
                by = sweep_predictions(at, pace, tops[0] - at.particles, 1, by, tape, adj)
        adj.damping[g] = by.damping_factor
        adj.table_friction[g] = by.table
        adj.contact_friction[g] = by.contact
        adj.stiffness[g] = by.inverse_dt2

    return sweep
