"""How much tape the substeps of a rollout need, and tapes with room for them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from ...errors import InputError
from ..lanes.tape import (
    BODY_SCALARS,
    BODY_WORDS,
    BOX_TRIANGLE_SCALARS,
    COUNTERS,
    GRIP_WORDS,
    TRIANGLE_SCALARS,
    TRIANGLE_WORDS,
)
from ..packing.data import SolverData
from ..packing.mirrored import Mirrored, aligned

__all__ = ["Stacks", "TapeRoom", "new_stacks"]

MOST = 2**31 - 1
"""Elements of one stack at most: whole numbers of 32 bits count them."""


_LESS = 'allow more memory, use storage="replay", or record fewer worlds at once'
_NOTES = {"first": 4, "end": 4, "top": 4, "steps": 0, "until": 0, "full": 0}
"""Whole numbers of a tape by group: so many each, 0: a number and no vector."""


@dataclass(frozen=True, eq=False)
class Stacks:
    """The tape of one segment of a rollout: room (groups, 4) for elements of x, v, k and s."""

    struct: Any
    room: np.ndarray
    arrays: dict[str, Any]
    notes: dict[str, Mirrored]
    nbytes: int

    def read(self, name: str) -> np.ndarray:
        """One of the tape's whole numbers by group, as the last launch left it."""
        self.notes[name].to_host()
        return self.notes[name].view

    def used(self) -> np.ndarray:
        """Elements (groups, 4) that the last launch left on it."""
        used: np.ndarray = self.read("top") - self.read("first")
        return used

    def full(self) -> np.ndarray:
        """Which groups (groups,) had no room for another substep."""
        full: np.ndarray = self.read("full") > 0
        return full


def new_stacks(data: SolverData, control: dict[str, Mirrored], room: np.ndarray) -> Stacks:
    """A tape with room (groups, 4) for so many elements."""
    t, device = data.types, data.device
    struct = t.Tape()
    end = np.cumsum(room, axis=0)
    arrays: dict[str, Any] = {}
    for column, (name, dtype) in enumerate((("x", t.V3), ("v", t.V), ("k", wp.int32), ("s", t.S))):
        count = max(int(end[-1, column]), 1)
        if device.is_cpu:
            arrays[name] = aligned(count, dtype)[0]
        else:
            arrays[name] = wp.empty(count, dtype=dtype, device=device)
    notes = {
        name: Mirrored(
            data.group_count,
            wp.vec4i if width else wp.int32,
            device,
            np.int32,
            (width,) if width else (),
        )
        for name, width in _NOTES.items()
    }
    notes["first"].view[...], notes["end"].view[...] = end - room, end
    for name, mirrored in notes.items():
        mirrored.to_device()
        arrays[name] = mirrored.array
    for name, mirrored in control.items():
        arrays[name] = mirrored.array
    flat = wp.array(
        ptr=arrays["x"].ptr,
        dtype=data.scalar,
        shape=(arrays["x"].capacity // np.dtype(data.number).itemsize,),
        device=device,
    )
    struct.part = 1
    for name, array in (*arrays.items(), ("x_flat", flat)):
        setattr(struct, name, array)
    return Stacks(struct, room, arrays, notes, int((room @ _sizes(data)).sum()))


class TapeRoom:
    """Learns how much of the tape a substep takes, by what was taped and what is near.

    Room is counted in elements (groups, 4). `use` is what a substep took, None before any was
    taped; a tape has `spare` room on top, as the kernel begins no substep that might not fit. The
    spare includes every box with every triangle and, twice, with every particle: once a tape, not
    once a substep, that is less than a handful of substeps take.
    """

    def __init__(self, data: SolverData, control: dict[str, Mirrored]) -> None:
        self._data, self._control = data, control
        self.sizes = _sizes(data)
        self.use: np.ndarray | None = None
        self._least, self._solid = _least(data), _solid(data)
        self.spare = 2.0 * self._least + self._solid

    def per_substep(self) -> float:
        """Bytes that a substep takes of all stacks together."""
        return float(((self._least if self.use is None else self.use) * self.sizes).sum())

    def room(self, length: int) -> np.ndarray:
        """Room for `length` substeps."""
        use = self._least if self.use is None else 1.1 * self.use
        room: np.ndarray = np.ceil(use * length + self.spare).astype(int)
        return room

    def nbytes(self, room: np.ndarray) -> int:
        """Bytes of a tape with the room (groups, 4).

        Raises:
            InputError: it has more elements than can be counted.
        """
        if int(room.sum(axis=0).max()) > MOST:
            raise InputError(f"{int(room.sum())} elements do not fit on a tape: {_LESS}")
        return int((room * self.sizes).sum())

    def check(self, nbytes: int, memory: int) -> int:
        """So many bytes, if that is no more than `memory`.

        Raises:
            InputError: it is.
        """
        if nbytes > memory:
            raise InputError(f"the tape would need {nbytes} bytes of {memory}: {_LESS}")
        return nbytes

    def learn(self, stacks: Stacks, steps: int | np.ndarray) -> None:
        """Take in how much `steps` substeps took, of all groups or of each (groups,)."""
        used = stacks.used() / np.reshape(steps, (-1, 1))
        self.use = used if self.use is None else np.maximum(self.use, used)
        self.grow()

    def grow(self, *, double: bool = False) -> None:
        """Spare room for the worst substep with the lists as they are."""
        self.spare = np.maximum(self.spare, self._worst())
        if double:
            self.spare = 2 * self.spare

    def _worst(self) -> np.ndarray:
        """What a substep needs at worst with the lists as they are."""
        data = self._data
        counters = self._control["counters"]
        counters.to_host()
        near = counters.view.reshape(-1, COUNTERS)[: data.group_count, 1]
        listed = np.zeros(data.group_count)
        if data.has_sheets:
            for name in ("cells.count", "cells.edge_count"):
                data.arrays[name].to_host()
                counts = data.arrays[name].view[: data.group_count * data.lanes]
                if len(counts) == data.group_count * data.lanes:
                    listed += counts.reshape(-1, data.lanes).sum(axis=1)
        words, scalars = near + TRIANGLE_WORDS * listed, TRIANGLE_SCALARS * listed
        contacts = np.stack([2 * near, 0 * near, words, scalars], axis=1)
        worst: np.ndarray = self._least + self._solid + 1.5 * contacts
        return worst


def _least(data: SolverData) -> np.ndarray:
    """What any substep needs; contacts come on top."""
    rows = []
    for k in data.group_topology:
        top = data.topologies[k]
        springs, particles = len(top.spring_ij) * top.passes, top.particle_count
        words = springs + top.passes + particles + 2 * data.lanes * (GRIP_WORDS + 4) + 8
        bodies = top.body_count * data.lanes
        words += BODY_WORDS * bodies
        rows.append((2 * springs + 6 * particles, particles + 8, words, BODY_SCALARS * bodies))
    return np.array(rows)


def _solid(data: SolverData) -> np.ndarray:
    """What contacts of all boxes with all particles and triangles would need."""
    rows = []
    for k in data.group_topology:
        top = data.topologies[k]
        solid = len(top.shape_body) * (2 * top.particle_count + len(top.sheet_triangle))
        solid *= data.lanes
        rows.append((0, 0, BODY_WORDS * solid, BOX_TRIANGLE_SCALARS * solid))
    return np.array(rows)


def _sizes(data: SolverData) -> np.ndarray:
    """Bytes of an element of each stack (4,)."""
    scalar = np.dtype(data.number).itemsize
    return np.array([3 * data.lanes * scalar, data.lanes * scalar, 4, scalar])
