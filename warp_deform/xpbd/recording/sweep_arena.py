"""`SweepArena`: arrays in which parts of a launch are taped again and swept."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import warp as wp

from ..bodies.body_contact import VISIT
from ..bodies.body_visits import VISITS
from ..continuing.continued_launch import ContinuedLaunch
from ..kernels.adjoint import adjoint_kernel
from ..kernels.forward import forward_kernel
from ..lanes.tape import COUNTERS, STATE
from ..packing.mirrored import Mirrored
from .checkpoint import Checkpoints
from .derivatives import Derivatives
from .tape_room import Stacks, TapeRoom, new_stacks

__all__ = ["SWEPT", "SweepArena", "contact_notes"]

SWEPT = ("topology", "springs", "pairs", "shapes", "group", "particles", "bodies", "contacts",
         "grips", "sheets", "lines")  # fmt: skip
"""Structs that the backward kernel takes."""


def contact_notes(data: Any) -> dict[str, Any]:
    """What the sweep notes of contacts of bodies, as fields of `Contacts`."""
    contacts, device = len(data.arrays["contacts.mu"].view), data.device
    return {
        "code": wp.zeros(contacts, dtype=wp.vec4i, device=device),
        "visit": wp.zeros(contacts * VISITS, dtype=wp.vec2i, device=device),
        "log": wp.zeros(contacts * VISITS * VISIT, dtype=data.scalar, device=device),
    }


class SweepArena:
    """A copy of all arrays of a launch, in which the launch itself and its solver are left alone.

    Args:
        arrays: of the launch, by name
        knots: room for those of a world
    """

    def __init__(self, launch: ContinuedLaunch, arrays: Mapping[str, Mirrored], knots: int) -> None:
        self._launch, self._data, data = launch, launch.data, launch.data
        self._arrays: dict[str, Mirrored] = {}
        for name, mirrored in arrays.items():
            self._arrays[name] = mirrored.like()
            self._arrays[name].view[...] = mirrored.view
            self._arrays[name].to_device()
        L, types, device = data.lanes, data.types, data.device
        state = Mirrored(data.group_count * STATE, types.V, device, data.number, (L,))
        counters = Mirrored(data.group_count * COUNTERS, wp.int32, device, np.int32, ())
        self._control = {"state": state, "counters": counters}
        self._checkpoints = Checkpoints(data, self._control, self._arrays)
        self._by = Derivatives(data, knots=data.group_count * L * knots)
        self._config: Any = None
        self._inputs: Mapping[str, np.ndarray] = {}
        self._again: Stacks | None = None
        self._on_again = -1

    @property
    def nbytes(self) -> int:
        """Bytes of the tape on which parts are run again."""
        return 0 if self._again is None else self._again.nbytes

    def _build(self) -> None:
        """Aim the launches at these arrays, with the settings of the solver's configuration."""
        launch, data = self._launch, self._data
        if self._config is launch.solver.config:
            return
        self._config, self._on_again = launch.solver.config, -1
        settings, blank = launch.settings(launch.substeps), data.types.Tape()
        inputs = [settings, *data.structs(self._arrays)[:-1], blank]
        self._tape_at = len(inputs) - 1
        self._forward = launch.solver.group_launch(
            forward_kernel(*data.variant, taped=True), inputs
        )
        swept = [data.struct(name, self._arrays) for name in SWEPT]
        for name, array in contact_notes(data).items():
            setattr(swept[SWEPT.index("contacts")], name, array)
        self._sweep = launch.solver.group_launch(
            adjoint_kernel(*data.variant),
            [settings, *swept, blank, self._by.by_state, self._by.by_bodies],
        )

    def set_up(self, inputs: Mapping[str, np.ndarray], own: Mapping[str, np.ndarray]) -> None:
        """Write what a part was run with: what scenes are made of, and arrays of its own."""
        self._build()
        if inputs is not self._inputs:
            self._inputs = inputs
            self._write(inputs)
        self._write(own)

    def _write(self, values: Mapping[str, np.ndarray]) -> None:
        for name, array in values.items():
            self._arrays[name].view[...] = array
            self._arrays[name].to_device()

    def tape_again(
        self,
        number: int,
        checkpoint: Mapping[str, np.ndarray],
        room: TapeRoom,
        fits: Callable[[int], None],
    ) -> Stacks:
        """Run a part again from its checkpoint, on a tape.

        Args:
            number: of the part; the one that was run last is on the tape still
            fits: called with the bytes of a tape, it refuses what needs too much memory
        """
        while self._again is None or self._on_again != number:
            needed = room.room(self._launch.substeps)
            if self._again is None or (self._again.room < needed).any():
                self._again, self._on_again = None, -1
                fits(room.nbytes(needed))
                self._again = new_stacks(self._data, self._control, needed)
            tape = self._again
            self._checkpoints.restore(checkpoint)
            tape.struct.resume, tape.struct.last = 1, 0
            self._forward.set_param_at_index(self._tape_at, tape.struct)
            self._forward.launch(self._launch.substeps)
            full = tape.full().any()
            if full or room.use is None:
                room.learn(tape, np.maximum(tape.read("steps"), 1))
            if full:
                room.grow(double=True)
            else:
                self._on_again = number
        return self._again

    def sweep(
        self,
        tape: Stacks,
        masses: np.ndarray,
        cotangents: Mapping[str, np.ndarray],
        inputs: Mapping[str, np.ndarray],
    ) -> dict[str, np.ndarray]:
        """Take back what is on a tape, see `RecordedLaunch.sweep`."""
        by, first = self._by, 1 + len(SWEPT)
        by.clear(masses)
        by.add(cotangents)
        by.by_state.parts = by.by_state.leave = 0
        self._sweep.set_param_at_index(first, tape.struct)
        self._sweep.set_param_at_index(first + 1, by.by_state)
        self._sweep.launch(self._launch.substeps)
        return by.read(inputs, self._launch.dt, parts=False)
