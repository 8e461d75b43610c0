"""What a thread keeps about its group of worlds: where their data stand, their pace, their state.

These structs live in registers and on the stack. A function gets a copy of what it takes, so one
that changes a `Run` returns it.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from .algebra import div, mul, sub  # noqa: F401  (operators are found by name)
from .structures import structures

__all__ = ["group_state"]


@functools.cache
def group_state(scalar: Any, lanes: int) -> SimpleNamespace:
    """`Span`, `Pace` and `Run`, and `span_of` and `pace_of`, which read the first two.

    A `Span` says where the data of group `g` stand, a `Pace` what a substep is made of, lane by
    lane, and a `Run` how far the launch of each lane is.
    """
    t = structures(scalar, lanes)
    S, V, V3, L = t.S, t.V, t.V3, t.L
    Settings, Topology, Group, Sheets = t.Settings, t.Topology, t.Group, t.Sheets

    @wp.struct
    class Span:
        """Where a group's data stand in the arrays; lane l's bodies begin at b0 + l * bodies."""

        g: int
        k: int  # topology
        world0: int  # world in lane 0
        p0: int  # first particle
        particles: int
        radii: int  # first of the particles' radii
        s0: int  # first spring
        s1: int  # behind the last one
        passes: int  # over them, in a substep
        b0: int  # first body of lane 0
        bodies: int  # of one world
        shape0: int  # first box of lane 0
        shapes: int  # of one world
        near0: int  # first of the listed near pairs
        triangles: int  # of one world

    @wp.struct
    class Pace:
        """Length of a substep [s] and what follows from it, from gravity and from friction."""

        dt: S
        inverse_dt: S
        max_recovery: S  # farthest that a contact separates in a substep [m]
        damping_factor: V  # share of its velocity that air damping leaves
        damped_dt: V  # damping_factor * dt
        gravity: V3  # [m/s^2]
        fall: V3  # velocity that gravity adds [m/s]
        inverse_dt2: V  # by which a compliance is multiplied, over the stiffness factor
        table_mu: V
        contact_mu: V

    @wp.struct
    class Run:
        """How far a launch is, lane by lane: numbers of substeps, flags 0 or 1, lengths [m]."""

        on: V  # still simulated
        steps: V  # done
        quiet: V  # in a row at rest
        holding: V  # something is gripped
        calm: V  # left that are clamped to the calm speed
        stale: V  # the list of near pairs has to be made anew
        fresh: V  # triangles have been listed in this launch
        travel: V  # farthest way of a particle since the list was made
        clamped: V  # in which the speed clamp acted
        free_time: V  # since the launch began or something was let go [s]
        least: V  # to be done at least
        drift: V3  # of the frame in which triangles are listed
        substep: int
        near_count: int  # listed near pairs
        longest_push: int  # substeps of the longest push

    @wp.func
    def span_of(g: int, top: Topology, group: Group, sheets: Sheets):
        at = Span()
        k = group.topology[g]
        at.g = g
        at.k = k
        at.world0 = g * wp.static(L)
        at.p0 = group.particle_start[g]
        at.particles = top.particle_count[k]
        at.radii = top.particle_start[k]
        at.s0 = top.spring_start[k]
        at.s1 = top.spring_start[k + 1]
        at.passes = top.passes[k]
        at.b0 = group.body_start[g]
        at.bodies = top.body_count[k]
        at.shape0 = group.shape_start[g]
        at.shapes = top.shape_count[k]
        at.near0 = group.near_start[g]
        at.triangles = sheets.first[k + 1] - sheets.first[k]
        return at

    @wp.func
    def pace_of(g: int, st: Settings, group: Group):
        pace = Pace()
        dt = st.dt
        one = V(S(1.0))
        inverse_dt = S(1.0) / dt
        gravity = group.gravity[g]
        damping_factor = wp.max(V(S(0.0)), one - group.damping[g] * dt)
        pace.dt = dt
        pace.inverse_dt = inverse_dt
        pace.max_recovery = st.recovery * dt
        pace.damping_factor = damping_factor
        pace.damped_dt = damping_factor * dt
        pace.gravity = gravity
        pace.fall = gravity * dt
        pace.inverse_dt2 = one * (inverse_dt * inverse_dt) / group.stiffness[g]
        pace.table_mu = group.table_friction[g]
        pace.contact_mu = group.contact_friction[g]
        return pace

    return SimpleNamespace(
        **vars(t), Span=Span, Pace=Pace, Run=Run, span_of=span_of, pace_of=pace_of
    )
