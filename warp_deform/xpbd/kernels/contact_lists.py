"""What may touch soon: lists of near pairs, triangles and edges, made anew where they are stale."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..contact.cell_list import cell_list
from ..contact.edge_list import edge_list
from ..contact.sphere_contact import sphere_contact
from ..lanes.algebra import add, any_less, mul, select, sub  # noqa: F401  (operators by name)
from ..lanes.group_state import group_state

__all__ = ["contact_lists"]


@functools.cache
def contact_lists(scalar: Any, lanes: int, with_sheets: bool, with_edges: bool) -> SimpleNamespace:
    """`list_contacts` brings a group's lists up to date and returns its `Run`; `count_listed`
    counts the pairs of triangles and edges of all lanes.

    Near pairs are listed for all lanes at once. Triangles are listed lane by lane, in a frame that
    drifts with the world, so that a fall does not make lists stale.
    """
    t = group_state(scalar, lanes)
    S, V, L = t.S, t.V, t.L
    Span, Pace, Run = t.Span, t.Pace, t.Run
    Settings, Topology, Group, Particles = t.Settings, t.Topology, t.Group, t.Particles
    Pairs, Near, Watch, Sheets, Cells = t.Pairs, t.Near, t.Watch, t.Sheets, t.Cells
    list_near = sphere_contact(scalar, lanes).list_near
    cells_ = cell_list(scalar, lanes)
    common_step, moved_since = cells_.common_step, cells_.moved_since
    list_triangles = cells_.list_triangles
    list_edges = edge_list(scalar, lanes).list_edges

    @wp.func
    def list_contacts(
        at: Span,
        pace: Pace,
        run: Run,
        st: Settings,
        top: Topology,
        group: Group,
        particles: Particles,
        pairs: Pairs,
        near: Near,
        sheets: Sheets,
        cells: Cells,
        watch: Watch,
    ):
        zero = V(S(0.0))
        if any_less(zero - run.stale, S(0.0)):
            run.near_count = list_near(
                at.g,
                at.p0,
                at.near0,
                group.near_capacity[at.g],
                top.pair_start[at.k],
                top.pair_start[at.k + 1],
                st.margin,
                run.stale,
                run.on,
                particles,
                pairs,
                near,
                watch,
                at.particles,
            )
            run.travel = select(run.stale, zero, run.travel)
        if wp.static(with_sheets):
            if at.triangles > 0:
                common = common_step(at.p0, at.particles, pace.dt, particles)
                run.drift = run.drift + common * run.on
                far = moved_since(at.p0, at.particles, run.drift, particles, cells)
                fresh = run.fresh
                for lane in range(wp.static(L)):
                    if run.on[lane] > S(0.0) and (fresh[lane] < S(0.5) or far[lane] > S(0.0)):
                        anew = fresh[lane] < S(0.5)
                        fresh[lane] = S(1.0)
                        left = list_triangles(
                            at.g,
                            lane,
                            at.k,
                            at.p0,
                            st.margin,
                            anew,
                            run.drift,
                            common,
                            top,
                            sheets,
                            cells,
                        )
                        if wp.static(with_edges):
                            left += list_edges(at.g, lane, at.k, at.p0, anew, top, sheets, cells)
                        over = watch.overflow[at.g]
                        over[lane] = wp.max(over[lane], S(left))
                        watch.overflow[at.g] = over
                run.fresh = fresh
        return run

    @wp.func
    def count_listed(at: Span, cells: Cells):
        count = int(0)
        if wp.static(with_sheets):
            for lane in range(wp.static(L)):
                count += cells.count[at.world0 + lane]
                if wp.static(with_edges):
                    count += cells.edge_count[at.world0 + lane]
        return count

    return SimpleNamespace(list_contacts=list_contacts, count_listed=count_listed)
