"""Sleep of fabrics: what lies still on something stays where it is until it is disturbed.

One pass over the constraints leaves single particles of a heap trembling and crawling for ever. A
particle falls asleep when it has stayed within `reach` of its `anchor` for `sleep_after`. That it
lies on something needs no test of its own: in that time gravity would have taken it farther, and a
piece of which anything is held or pinned never sleeps, so nothing but contact can have carried it.
Asleep, a particle ends every substep where it began, with velocity 0.

It wakes when the substep would have moved it faster than `wake`: when it is pulled or struck. The
whole piece wakes when something of it is gripped, and when a body that moves touches a fabric of
the world. Its sleepers wake when they are the most of it and what carries them gives way: when
together they would gain momentum as if half their weight were lost or added.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..lanes.algebra import add, any_less, div, dot, less, mul, root, select, sub  # noqa: F401
from ..lanes.group_state import group_state
from ..lanes.tape import Kind

__all__ = ["sleep", "sleep_adjoint"]

LOST = 0.5
"""Share of the weight of the sleepers of a piece that wakes them when nothing carries it."""


@functools.cache
def sleep(scalar: Any, lanes: int, taped: bool = False) -> SimpleNamespace:
    """`rest_fabrics(...)` ends a substep for all fabrics of a group.

    `taped`, it leaves who sleeps on the tape of V from `tv` on, a number for every particle.
    `rouse(...)`, before a launch, wakes sleepers that were moved or given a velocity.
    """
    t = group_state(scalar, lanes)
    S, V, V3 = t.S, t.V, t.V3
    Span, Pace, Settings, Topology = t.Span, t.Pace, t.Settings, t.Topology
    Particles, Springs, Tape = t.Particles, t.Springs, t.Tape

    @wp.func
    def rouse(at: Span, on: V, st: Settings, particles: Particles):
        zero = V(S(0.0))
        reach = st.sleep * st.sleep_after
        for i in range(at.p0, at.p0 + at.particles):
            still = particles.still[i]
            way = particles.x[i] - particles.anchor[i]
            stirs = wp.max(
                less(zero, dot(particles.v[i], particles.v[i])),
                less(V(reach * reach), dot(way, way)),
            )
            stirs = stirs * on * less(V(st.sleep_after), still)
            particles.still[i] = select(stirs, zero, still)

    @wp.func
    def rest_fabrics(
        at: Span,
        pace: Pace,
        st: Settings,
        stirred: V,
        on: V,
        tv: int,
        top: Topology,
        particles: Particles,
        springs: Springs,
        tape: Tape,
    ):
        zero = V(S(0.0))
        one = V(S(1.0))
        dt = pace.dt
        late = V(st.sleep_after)
        reach = st.sleep * st.sleep_after
        pull = root(dot(pace.gravity, pace.gravity))
        # a fall from rest and back takes it farther than that from its anchor
        heavy = less(V(S(12.0) * reach), pull * (st.sleep_after * st.sleep_after))
        if wp.static(taped):
            for i in range(at.particles):
                tape.v[tv + i] = zero
        for piece in range(top.piece_start[at.k], top.piece_start[at.k + 1]):
            first = springs.member_first[piece]
            last = springs.member_first[piece + 1]
            may = heavy * on * (one - stirred)
            whole = zero
            mass = zero
            momentum = V3(zero, zero, zero)
            for n in range(first, last):
                i = at.p0 + springs.members[n]
                w = particles.w[i]
                may = may * less(zero, w)
                m = one / wp.max(w, V(S(1.0e-9)))
                whole = whole + m
                m = m * less(late, particles.still[i])
                mass = mass + m
                momentum = momentum + particles.v[i] * m
            most = pull * mass * (S(LOST) * dt)
            lost = less(most * most, dot(momentum, momentum)) * less(whole, mass * S(2.0))
            for n in range(first, last):
                i = at.p0 + springs.members[n]
                still = particles.still[i]
                slept = less(late, still)
                x = particles.x[i]
                v = particles.v[i]
                asleep = may * slept * (one - lost) * less(dot(v, v), V(st.wake * st.wake))
                if any_less(zero - asleep, S(0.0)):
                    o = particles.xp[i]
                    x = V3(
                        select(asleep, o.x, x.x),
                        select(asleep, o.y, x.y),
                        select(asleep, o.z, x.z),
                    )
                    particles.x[i] = x
                    particles.v[i] = V3(
                        select(asleep, zero, v.x),
                        select(asleep, zero, v.y),
                        select(asleep, zero, v.z),
                    )
                    if wp.static(taped):
                        tape.v[tv + springs.members[n]] = asleep
                anchor = particles.anchor[i]
                way = x - anchor
                stays = may * less(dot(way, way), V(reach * reach))
                # who wakes begins anew, as who leaves his place
                stays = wp.max(asleep, stays * (one - slept))
                particles.still[i] = select(on, (still + V(dt)) * stays, still)
                moves = on * (one - stays)
                particles.anchor[i] = V3(
                    select(moves, x.x, anchor.x),
                    select(moves, x.y, anchor.y),
                    select(moves, x.z, anchor.z),
                )

    return SimpleNamespace(rouse=rouse, rest_fabrics=rest_fabrics)


@functools.cache
def sleep_adjoint(scalar: Any, lanes: int) -> SimpleNamespace:
    """`sweep_rest` takes sleep back: who slept ended where he began, without a velocity."""
    t = group_state(scalar, lanes)
    S, V, Span, Tape, Adjoint = t.S, t.V, t.Span, t.Tape, t.Adjoint

    @wp.func
    def sweep_rest(at: Span, tv: int, counts: int, tape: Tape, adj: Adjoint):
        zero = V(S(0.0))
        one = V(S(1.0))
        fired = zero
        for k in range(at.particles):
            asleep = tape.v[tv + k]
            if any_less(zero - asleep, S(0.0)):
                i = at.p0 + k
                back = adj.x[i] * asleep
                adj.x[i] = adj.x[i] - back
                adj.xp[i] = adj.xp[i] + back
                adj.v[i] = adj.v[i] * (one - asleep)
                fired = fired + asleep
        kind = counts + wp.static(int(Kind.SLEEP))
        adj.fired[kind] = adj.fired[kind] + fired

    return SimpleNamespace(sweep_rest=sweep_rest)
