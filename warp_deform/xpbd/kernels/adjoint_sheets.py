"""The phases of fabrics taken back: sleep, viscosity, contacts of triangles and edges, tethers."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..contact.edge_contact_adjoint import edge_contact_adjoint
from ..contact.triangle_contact_adjoint import triangle_contact_adjoint
from ..lanes.algebra import add, any_less, sub  # noqa: F401  (operators are found by name)
from ..lanes.lane_access import lane_access
from ..lanes.sweep_state import sweep_state
from ..lanes.tape import TRIANGLE_SCALARS, TRIANGLE_WORDS, Kind
from ..springs.sleep import sleep_adjoint
from ..springs.tether import tether_adjoint
from ..springs.viscosity import viscosity_adjoint

__all__ = ["adjoint_sheets"]


@functools.cache
def adjoint_sheets(scalar: Any, lanes: int, with_edges: bool) -> SimpleNamespace:
    """`sweep_sleep`, `sweep_viscosity`, `sweep_fabrics`, `sweep_tethers`; see `adjoint_phases`."""
    t = sweep_state(scalar, lanes)
    S, V, V3, L = t.S, t.V, t.V3, t.L
    Span, Pace, By, Substep, Always = t.Span, t.Pace, t.By, t.Substep, t.Always
    Settings, Topology, Springs = t.Settings, t.Topology, t.Springs
    Particles, Sheets, Tape, Adjoint = t.Particles, t.Sheets, t.Tape, t.Adjoint
    sweep_rest = sleep_adjoint(scalar, lanes).sweep_rest
    sweep_damping = viscosity_adjoint(scalar, lanes).sweep_damping
    sweep_triangle = triangle_contact_adjoint(scalar, lanes).sweep_triangle
    sweep_edge = edge_contact_adjoint(scalar, lanes).sweep_edge
    sweep_tether = tether_adjoint(scalar, lanes).sweep_tether
    count_lanes = lane_access(scalar, lanes).count_lanes

    @wp.func
    def sweep_sleep(at: Span, st: Settings, now: Substep, tops: wp.vec4i, tape: Tape, adj: Adjoint):
        if st.sleep > S(0.0):
            tops[1] -= at.particles
            sweep_rest(at, tops[1], now.counts, tape, adj)
        return tops

    @wp.func
    def sweep_viscosity(
        at: Span,
        st: Settings,
        now: Substep,
        always: Always,
        tops: wp.vec4i,
        top: Topology,
        springs: Springs,
        tape: Tape,
        adj: Adjoint,
    ):
        if st.viscous > S(0.0) and now.number % st.damp_every == 0:
            count_lanes(now.counts + wp.static(int(Kind.VISCOSITY)), now.on, always.damped, adj)
            tops[0] -= 2 * at.particles
            sweep_damping(at, tops[0], st.viscous, now.on, top, springs, tape, adj)
        return tops

    @wp.func
    def sweep_fabrics(
        at: Span,
        pace: Pace,
        now: Substep,
        by: By,
        tops: wp.vec4i,
        top: Topology,
        sheets: Sheets,
        tape: Tape,
        adj: Adjoint,
    ):
        tk = int(tops[2])
        ts = int(tops[3])
        by_contact = by.contact
        if at.triangles > 0:
            for r in range(wp.static(L)):
                lane = wp.static(L) - 1 - r
                if now.on[lane] > S(0.0):
                    if wp.static(with_edges):
                        tk -= 1
                        for _ in range(tape.k[tk]):
                            tk -= wp.static(TRIANGLE_WORDS)
                            ts -= wp.static(TRIANGLE_SCALARS)
                            sweep_edge(
                                tk,
                                ts,
                                now.finished,
                                lane,
                                at.p0,
                                at.radii,
                                pace.max_recovery,
                                now.counts,
                                top,
                                sheets,
                                tape,
                                adj,
                            )
                    tk -= 1
                    for _ in range(tape.k[tk]):
                        tk -= wp.static(TRIANGLE_WORDS)
                        ts -= wp.static(TRIANGLE_SCALARS)
                        by_contact[lane] = by_contact[lane] + sweep_triangle(
                            tk,
                            ts,
                            now.finished,
                            lane,
                            at.p0,
                            at.radii,
                            pace.contact_mu[lane],
                            pace.max_recovery,
                            now.counts,
                            top,
                            sheets,
                            tape,
                            adj,
                        )
        by.contact = by_contact
        tops[2] = tk
        tops[3] = ts
        return by, tops

    @wp.func
    def sweep_tethers(
        at: Span, now: Substep, tops: wp.vec4i, particles: Particles, tape: Tape, adj: Adjoint
    ):
        zero = V(S(0.0))
        tx = int(tops[0])
        tk = int(tops[2])
        if any_less(zero - now.holding, S(0.0)):
            tk -= wp.static(L)
            held = int(tk)
            tk -= 1
            by_held = V3(zero, zero, zero)
            for _ in range(tape.k[tk]):
                tk -= 1
                tx -= 1
                by_held = by_held + sweep_tether(
                    at.p0 + tape.k[tk], tape.x[tx], now.holding, now.counts, now.on, particles, adj
                )
            for lane in range(wp.static(L)):
                if tape.k[held + lane] >= 0:
                    i = at.p0 + tape.k[held + lane]
                    gx = adj.x[i]
                    gx.x[lane] = gx.x[lane] + by_held.x[lane]
                    gx.y[lane] = gx.y[lane] + by_held.y[lane]
                    gx.z[lane] = gx.z[lane] + by_held.z[lane]
                    adj.x[i] = gx
        return wp.vec4i(tx, tops[1], tk, tops[3])

    return SimpleNamespace(
        sweep_sleep=sweep_sleep,
        sweep_viscosity=sweep_viscosity,
        sweep_fabrics=sweep_fabrics,
        sweep_tethers=sweep_tethers,
    )
