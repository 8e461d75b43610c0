"""The tape of a differentiated rollout, and how often constraints of each kind acted on it.

A taped launch leaves what the derivative of each constraint needs (its inputs, as differences where
those suffice) on one of four stacks of its group: V3, V, whole numbers, and scalars of one lane.
Constraints that always act leave no more; those that act now and then leave who they were as well,
numbered within their world, and every phase of a substep ends with their number. The backward sweep
pops in reverse, so it finds the very inputs, and takes the very branches, of the forward pass.
Nothing else of the state is needed: the sweep restores none.
"""

import functools
from enum import IntEnum
from types import SimpleNamespace
from typing import Any

import warp as wp

from .group_state import group_state

__all__ = [
    "BODY_SCALARS",
    "BODY_WORDS",
    "BOX_PARTICLE_SCALARS",
    "BOX_TRIANGLE_SCALARS",
    "COUNTERS",
    "GRIP_WORDS",
    "STATE",
    "TRIANGLE_SCALARS",
    "TRIANGLE_WORDS",
    "Kind",
    "RunColumn",
    "tape",
]

STATE = 14
"""Lane vectors of the kernel's own state per group."""
COUNTERS = 3
"""Whole numbers of the kernel's own state per group: substeps, near pairs, longest push."""
GRIP_WORDS = 8
"""Whole numbers on the tape for a lane that holds something."""
TRIANGLE_WORDS = 2
"""The same for a particle that touches a triangle, or an edge that touches another one."""
TRIANGLE_SCALARS = 13
"""Scalars of that pair: distance at which they touch, and the four positions [m]."""

BODY_SCALARS = 28
"""Of a body: pose, old pose, twist, inverse mass, and pose before contacts of bodies."""
BODY_WORDS = 2
"""Of a body, or of its contact with a particle or a triangle."""
BOX_PARTICLE_SCALARS = 13
"""Of that contact: position and old position of the particle, pose of the body."""
BOX_TRIANGLE_SCALARS = 16
"""The same with the positions of the triangle's corners."""


class RunColumn(IntEnum):
    """Places of a `Run`'s lane vectors in the kernel's own state, as `save_state` leaves them."""

    ON = 0
    STEPS = 1
    QUIET = 2
    HOLDING = 3
    CALM = 4
    STALE = 5
    CLAMPED = 8


class Kind(IntEnum):
    """What is counted in the sweep, world by world."""

    STRETCH = 0
    FOLD_LIMIT = 1
    STRAIN_LIMIT = 2
    BEND = 3
    CONTACT = 4
    CONTACT_SLOWED = 5
    TABLE = 6
    TABLE_SLIP = 7
    SPEED_CLAMP = 8
    GRIP = 9
    REACHED = 10
    RELEASE = 11
    TETHER = 12
    TRIANGLE_FACE = 13
    TRIANGLE_RIM = 14
    EDGE = 15
    SLEEP = 16
    VISCOSITY = 17
    BODY_TABLE = 18
    BODY_BODY = 19
    BODY_SLIP = 20
    BODY_SLEEP = 21
    BODY_CLAMP = 22
    BOX_PARTICLE = 23
    BOX_TRIANGLE = 24


@functools.cache
def tape(scalar: Any, lanes: int) -> SimpleNamespace:
    """`fetch_ahead(x, begin, bytes)`: have a part of the stack of V3 brought near the processor, as
    the sweep reads backwards, which hardware foresees badly.

    `has_room(...)`: whether a substep with so many `listed` pairs of triangles and edges fits on
    the tape, and the grips of the next substep with it.

    `load_state(g, tape)`, `save_state(g, run, tape)`: a group's `Run` between launches.

    `record_pose(at, x, q, tape)` leaves a position and a quaternion among the scalars of one lane;
    `position(at, tape)` and `quaternion(at, tape)` read such.
    """
    t = group_state(scalar, lanes)
    L, V3, R3, Q = t.L, t.V3, t.R3, t.Q
    Tape, Span, Run = t.Tape, t.Span, t.Run
    far = "const char* p = (const char*)(x.data + (begin > 0 ? begin : 0));"
    lines = "for (int i = 0; i < bytes; i += 64) __builtin_prefetch(p + i, 0, 2);"

    @wp.func_native(f"#if !defined(__CUDA_ARCH__)\n{far} {lines}\n#endif\n")
    def fetch_ahead(x: wp.array(dtype=V3), begin: int, bytes: int): ...

    @wp.func
    def has_room(at: Span, run: Run, listed: int, tops: wp.vec4i, tape: Tape):
        springs = (at.s1 - at.s0) * at.passes
        particles = at.particles
        near = run.near_count
        bodies = at.bodies * wp.static(L)
        solid = at.shapes * (2 * at.particles + at.triangles) * wp.static(L)
        end = tape.end[at.g]
        words = springs + at.passes + particles + near + wp.static(TRIANGLE_WORDS) * listed
        words += wp.static(2 * L * (GRIP_WORDS + 4) + 8) + wp.static(BODY_WORDS) * (bodies + solid)
        return (
            tops[0] + 2 * springs + 6 * particles + 2 * near <= end[0]
            and tops[1] + particles + 8 <= end[1]
            and tops[2] + words <= end[2]
            and tops[3]
            + wp.static(TRIANGLE_SCALARS) * listed
            + wp.static(BODY_SCALARS) * bodies
            + wp.static(BOX_TRIANGLE_SCALARS) * solid
            <= end[3]
        )

    @wp.func
    def load_state(g: int, tape: Tape):
        run = Run()
        at = g * wp.static(STATE)
        run.on = tape.state[at]
        run.steps = tape.state[at + 1]
        run.quiet = tape.state[at + 2]
        run.holding = tape.state[at + 3]
        run.calm = tape.state[at + 4]
        run.stale = tape.state[at + 5]
        run.fresh = tape.state[at + 6]
        run.travel = tape.state[at + 7]
        run.clamped = tape.state[at + 8]
        run.free_time = tape.state[at + 9]
        run.least = tape.state[at + 10]
        run.drift = V3(tape.state[at + 11], tape.state[at + 12], tape.state[at + 13])
        at = g * wp.static(COUNTERS)
        run.substep = tape.counters[at]
        run.near_count = tape.counters[at + 1]
        run.longest_push = tape.counters[at + 2]
        return run

    @wp.func
    def save_state(g: int, run: Run, tape: Tape):
        at = g * wp.static(STATE)
        tape.state[at] = run.on
        tape.state[at + 1] = run.steps
        tape.state[at + 2] = run.quiet
        tape.state[at + 3] = run.holding
        tape.state[at + 4] = run.calm
        tape.state[at + 5] = run.stale
        tape.state[at + 6] = run.fresh
        tape.state[at + 7] = run.travel
        tape.state[at + 8] = run.clamped
        tape.state[at + 9] = run.free_time
        tape.state[at + 10] = run.least
        tape.state[at + 11] = run.drift.x
        tape.state[at + 12] = run.drift.y
        tape.state[at + 13] = run.drift.z
        at = g * wp.static(COUNTERS)
        tape.counters[at] = run.substep
        tape.counters[at + 1] = run.near_count
        tape.counters[at + 2] = run.longest_push

    @wp.func
    def record_pose(at: int, x: R3, q: Q, tape: Tape):
        for k in range(3):
            tape.s[at + k] = x[k]
        for k in range(4):
            tape.s[at + 3 + k] = q[k]

    @wp.func
    def position(at: int, tape: Tape):
        return R3(tape.s[at], tape.s[at + 1], tape.s[at + 2])

    @wp.func
    def quaternion(at: int, tape: Tape):
        return Q(tape.s[at], tape.s[at + 1], tape.s[at + 2], tape.s[at + 3])

    return SimpleNamespace(
        has_room=has_room,
        fetch_ahead=fetch_ahead,
        load_state=load_state,
        save_state=save_state,
        record_pose=record_pose,
        position=position,
        quaternion=quaternion,
    )
