"""What a thread keeps while it sweeps backwards: the substep at hand, derivatives by parameters."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from .group_state import group_state

__all__ = ["sweep_state"]


@functools.cache
def sweep_state(scalar: Any, lanes: int) -> SimpleNamespace:
    """`By`, `Substep` and `Always`, beside the structs of `group_state`."""
    t = group_state(scalar, lanes)
    V = t.V

    @wp.struct
    class By:
        """Derivatives of the loss by the parameters of each lane's world."""

        damping_factor: V  # share of velocity that air damping leaves
        inverse_dt2: V  # as in `Pace`, so by the stiffness factor
        table: V  # friction of the table
        contact: V  # friction of contacts

    @wp.struct
    class Substep:
        """What the tape says of a substep."""

        on: V
        fastest: V  # longest step that the clamp allowed [m]
        holding: V
        number: int
        ahead: int  # so far ahead on the stack of V3 is what is fetched
        counts: int  # first of the group's counters of constraints that acted
        finished: int  # top of the stack of V3 before particles were finished

    @wp.struct
    class Always:
        """What is the same in all substeps."""

        bends: int  # springs of this kind
        stretches: int
        damped: int  # pairs of neighbours in fabrics
        longest_push: int  # [substeps]

    return SimpleNamespace(**vars(t), By=By, Substep=Substep, Always=Always)
