"""The constraints between particles, in the order of a substep: springs, tethers, contacts."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ...objects.attributes import SpringMode
from ..contact.edge_contact import edge_contact
from ..contact.edge_contact_adjoint import edge_contact_adjoint
from ..contact.sphere_contact import sphere_contact
from ..contact.triangle_contact import triangle_contact
from ..contact.triangle_contact_adjoint import triangle_contact_adjoint
from ..lanes.algebra import any_less, mul, sub  # noqa: F401  (operators are found by name)
from ..lanes.group_state import group_state
from ..lanes.tape import TRIANGLE_SCALARS, TRIANGLE_WORDS
from ..springs.beam import beam, beam_adjoint
from ..springs.bending import bending
from ..springs.chain import chain, chain_adjoint
from ..springs.distance import distance
from ..springs.tether import tether, tether_adjoint

__all__ = ["particle_solve"]


@functools.cache
def particle_solve(
    scalar: Any, lanes: int, with_sheets: bool, with_edges: bool, with_lines: bool, taped: bool
) -> SimpleNamespace:
    """`solve_particles(g, ...)`: the constraints of a group once; `taped`, each leaves what its
    adjoint needs on the tape from `tops` on. Returns the tops after that.
    """
    t = group_state(scalar, lanes)
    S, V, L = t.S, t.V, t.L
    project_distance = distance(scalar, lanes, with_sheets, taped).project_distance
    project_bend = bending(scalar, lanes, taped).project_bend
    project_chain = chain(scalar, lanes).project_chain
    record_chain = chain_adjoint(scalar, lanes).record_chain
    project_beam = beam(scalar, lanes).project_beam
    record_beam = beam_adjoint(scalar, lanes).record_beam
    project_contact = sphere_contact(scalar, lanes, taped).project_contact
    project_tether = tether(scalar, lanes).project_tether
    record_tether = tether_adjoint(scalar, lanes).record_tether
    project_triangles = triangle_contact(scalar, lanes).project_triangles
    record_triangles = triangle_contact_adjoint(scalar, lanes).record_triangles
    project_edges = edge_contact(scalar, lanes).project_edges
    record_edges = edge_contact_adjoint(scalar, lanes).record_edges
    Span, Pace, Run = t.Span, t.Pace, t.Run
    Particles, Springs, Lines, Pairs, Near = t.Particles, t.Springs, t.Lines, t.Pairs, t.Near
    Grips, Sheets, Cells, Tape, Topology = t.Grips, t.Sheets, t.Cells, t.Tape, t.Topology

    @wp.func
    def solve_springs(
        at: Span,
        tx: int,
        tk: int,
        inverse_dt2: V,
        particles: Particles,
        springs: Springs,
        lines: Lines,
        tape: Tape,
    ):
        """One pass over the springs; returns the tops of the stacks of V3 and of whole numbers."""
        p0 = at.p0
        mark = int(tk)
        for s in range(at.s0, at.s1):
            direct = bool(False)
            if wp.static(with_lines):
                direct = springs.mode[s] >= wp.static(int(SpringMode.CHAIN))
                count = springs.run[s]
                if direct and count > 0:
                    if springs.mode[s] == wp.static(int(SpringMode.CHAIN)):
                        if wp.static(taped):
                            record_chain(
                                s, count, p0, tx, inverse_dt2, particles, springs, lines, tape
                            )
                            tx += count
                        else:
                            project_chain(s, count, p0, inverse_dt2, particles, springs, lines)
                    elif wp.static(taped):
                        record_beam(s, count, p0, tx, inverse_dt2, particles, springs, lines, tape)
                        tx += count
                    else:
                        project_beam(s, count, p0, inverse_dt2, particles, springs, lines)
            if not direct and springs.mode[s] == wp.static(int(SpringMode.BEND)):
                project_bend(s, p0, tx, inverse_dt2, particles, springs, tape)
                if wp.static(taped):
                    tx += 1
            elif not direct:
                acted = project_distance(s, p0, tx, inverse_dt2, particles, springs, tape)
                if wp.static(taped):
                    if acted:
                        tx += 1
                        if springs.mode[s] != wp.static(int(SpringMode.EQUAL)):
                            tape.k[tk] = s
                            tk += 1
        if wp.static(taped):
            tape.k[tk] = tk - mark
            tk += 1
        return wp.vec2i(tx, tk)

    @wp.func
    def solve_particles(
        at: Span,
        pace: Pace,
        run: Run,
        tops: wp.vec4i,
        top: Topology,
        particles: Particles,
        springs: Springs,
        lines: Lines,
        pairs: Pairs,
        near: Near,
        grips: Grips,
        sheets: Sheets,
        cells: Cells,
        tape: Tape,
    ):
        zero = V(S(0.0))
        p0 = at.p0
        world0 = at.world0
        inverse_dt2 = pace.inverse_dt2
        if wp.static(with_lines):
            # each pass has its share of the stiffness
            inverse_dt2 = pace.inverse_dt2 * S(at.passes)
        contact_mu = pace.contact_mu
        max_recovery = pace.max_recovery
        holding = run.holding
        on = run.on
        tx = int(tops[0])
        tk = int(tops[2])
        ts = int(tops[3])
        mark = int(tk)
        # always in the same order: sweeping backwards in every other substep makes tight heaps
        # crawl for ever, and shells jitter
        if wp.static(with_lines):
            for _ in range(at.passes):
                solved = solve_springs(at, tx, tk, inverse_dt2, particles, springs, lines, tape)
                tx = solved[0]
                tk = solved[1]
        else:
            solved = solve_springs(at, tx, tk, inverse_dt2, particles, springs, lines, tape)
            tx = solved[0]
            tk = solved[1]
        if wp.static(with_sheets):
            if any_less(zero - holding, S(0.0)):
                held = particles.x[p0]
                for lane in range(wp.static(L)):
                    i = grips.particle[world0 + lane]
                    if i >= 0:
                        x = particles.x[p0 + i]
                        held.x[lane] = x.x[lane]
                        held.y[lane] = x.y[lane]
                        held.z[lane] = x.z[lane]
                if wp.static(taped):
                    mark = int(tk)
                for i in range(at.particles):
                    if wp.static(taped):
                        if record_tether(p0 + i, tx, holding, held, particles, tape):
                            tape.k[tk] = i
                            tx += 1
                            tk += 1
                    else:
                        project_tether(p0 + i, holding, held, particles)
                if wp.static(taped):
                    tape.k[tk] = tk - mark
                    tk += 1
                    for lane in range(wp.static(L)):
                        tape.k[tk] = grips.particle[world0 + lane]
                        tk += 1
        if wp.static(taped):
            mark = int(tk)
        for c in range(at.near0, at.near0 + run.near_count):
            acted = project_contact(
                c, p0, tx, contact_mu, max_recovery, particles, pairs, near, tape
            )
            if wp.static(taped):
                if acted:
                    tape.k[tk] = near.pair[c]
                    tx += 2
                    tk += 1
        if wp.static(taped):
            tape.k[tk] = tk - mark
            tk += 1
        if wp.static(with_sheets):
            if at.triangles > 0:
                for lane in range(wp.static(L)):
                    if on[lane] > S(0.0):
                        if wp.static(taped):
                            acted_count = record_triangles(
                                at.g,
                                lane,
                                p0,
                                at.radii,
                                grips.particle[world0 + lane],
                                tk,
                                ts,
                                contact_mu[lane],
                                max_recovery,
                                top,
                                sheets,
                                cells,
                                tape,
                            )
                            cells.met[world0 + lane] = acted_count % 2
                            acted_count = acted_count // 2
                            tk += wp.static(TRIANGLE_WORDS) * acted_count
                            ts += wp.static(TRIANGLE_SCALARS) * acted_count
                            tape.k[tk] = acted_count
                            tk += 1
                            if wp.static(with_edges):
                                acted_count = record_edges(
                                    at.g,
                                    lane,
                                    p0,
                                    at.radii,
                                    tk,
                                    ts,
                                    max_recovery,
                                    top,
                                    sheets,
                                    cells,
                                    tape,
                                )
                                tk += wp.static(TRIANGLE_WORDS) * acted_count
                                ts += wp.static(TRIANGLE_SCALARS) * acted_count
                                tape.k[tk] = acted_count
                                tk += 1
                        else:
                            hit = project_triangles(
                                at.g,
                                lane,
                                p0,
                                at.radii,
                                grips.particle[world0 + lane],
                                contact_mu[lane],
                                max_recovery,
                                top,
                                sheets,
                                cells,
                            )
                            cells.met[world0 + lane] = wp.where(hit, 1, 0)
                            if wp.static(with_edges):
                                project_edges(
                                    at.g, lane, p0, at.radii, max_recovery, top, sheets, cells
                                )
        return wp.vec4i(tx, tops[1], tk, ts)

    return SimpleNamespace(solve_particles=solve_particles)
