"""The arrays of the backward sweep: the tape that a launch leaves, and derivatives by the state.

They are numbered as the arrays of `structures` are.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from .algebra import lane_types

__all__ = ["adjoint_structures"]


@functools.cache
def adjoint_structures(scalar: Any, lanes: int) -> SimpleNamespace:
    """`Tape`, `Adjoint` and `BodyAdjoint` for one precision and width."""
    t = lane_types(scalar, lanes)
    S, V, V3, R3, Q, M33 = t.S, t.V, t.V3, t.R3, t.Q, t.M33

    @wp.struct
    class Tape:
        """What a taped launch leaves for the backward sweep: four stacks per group (see `tape`)."""

        part: int  # 1: the launch is a part of a rollout; also where no stack has room
        resume: int  # 1: the launch continues a rollout where `state` and `counters` left it
        last: int  # 1: the rollout ends with the launch
        x: wp.array(dtype=V3)
        v: wp.array(dtype=V)
        k: wp.array(dtype=int)
        s: wp.array(dtype=S)
        # tops of the four stacks, in this order, by group
        first: wp.array(dtype=wp.vec4i)
        end: wp.array(dtype=wp.vec4i)  # of the room for them
        top: wp.array(dtype=wp.vec4i)
        steps: wp.array(dtype=int)  # substeps on the tape
        until: wp.array(dtype=int)  # number of the substep after them
        full: wp.array(dtype=int)  # 1: there was no room for another substep
        state: wp.array(dtype=V)  # by group * STATE: what the kernel knows between launches
        counters: wp.array(dtype=int)  # by group * COUNTERS: the same in whole numbers
        x_flat: wp.array(dtype=S)  # `x` scalar by scalar (see `lane_access`)

    @wp.struct
    class Adjoint:
        """Derivatives of the loss by what is named, while the sweep goes back through the tape."""

        x: wp.array(dtype=V3)
        v: wp.array(dtype=V3)
        xp: wp.array(dtype=V3)  # by position at the start of the substep
        w: wp.array(dtype=V)  # not a derivative: inverse masses as they were in the substep
        mass: wp.array(dtype=V)  # by free inverse mass
        parts: int  # 1: `mass` and the next three are wanted, which takes longer
        radius: wp.array(dtype=V)  # of particles
        # by spring, at the number of a spring + the group's `spring_first`
        spring_first: wp.array(dtype=int)
        softness: wp.array(dtype=V)  # compliance, times `Pace.inverse_dt2` of a pass
        rest: wp.array(dtype=V)  # rest length
        # scratch of `viscosity`: positions, velocities, derivatives, and these over the masses
        then_x: wp.array(dtype=V3)
        then_v: wp.array(dtype=V3)
        then_g: wp.array(dtype=V3)
        then_h: wp.array(dtype=V3)
        damping: wp.array(dtype=V)  # by `Pace.damping_factor`; per group, as those below
        table_friction: wp.array(dtype=V)
        contact_friction: wp.array(dtype=V)
        stiffness: wp.array(dtype=V)  # by 1 / (stiffness dt^2)
        time: wp.array(dtype=S)  # of each knot, as those below
        position: wp.array(dtype=R3)
        rotation: wp.array(dtype=Q)
        shift: wp.array(dtype=R3)  # by group * L + lane
        leave: int  # 1: the tape before takes back the prediction of this tape's first substep
        pending: wp.array(dtype=int)  # 1: the tape after has left that to this one, by group
        fired: wp.array(dtype=V)  # by group * KINDS: constraints that acted, by kind
        # the same memory as arrays of V3 and V, scalar by scalar (see `lane_access`)
        x_flat: wp.array(dtype=S)
        xp_flat: wp.array(dtype=S)
        w_flat: wp.array(dtype=S)
        mass_flat: wp.array(dtype=S)
        radius_flat: wp.array(dtype=S)

    @wp.struct
    class BodyAdjoint:
        """Derivatives of the loss by the state of bodies, and scratch for those by contacts."""

        x: wp.array(dtype=R3)
        q: wp.array(dtype=Q)  # by its four numbers
        v: wp.array(dtype=R3)
        omega: wp.array(dtype=R3)
        xp: wp.array(dtype=R3)
        qp: wp.array(dtype=Q)
        w: wp.array(dtype=S)  # by inverse mass, at the same inertia
        dx: wp.array(dtype=R3)
        dr: wp.array(dtype=R3)
        spread: wp.array(dtype=M33)
        # by contact, as `Contacts`
        ra: wp.array(dtype=R3)
        rb: wp.array(dtype=R3)
        normal: wp.array(dtype=R3)
        across_u: wp.array(dtype=R3)
        across_v: wp.array(dtype=R3)
        weights: wp.array(dtype=R3)
        upper: wp.array(dtype=R3)
        steps: wp.array(dtype=R3)
        impulse: wp.array(dtype=R3)
        mu: wp.array(dtype=S)

    return SimpleNamespace(Tape=Tape, Adjoint=Adjoint, BodyAdjoint=BodyAdjoint)
