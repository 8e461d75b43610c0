"""`RecordedLaunch`: a launch that goes on, each part of which can be swept back by itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ...errors import InputError
from ..continuing.continued_launch import ContinuedLaunch
from ..continuing.lasting_grips import KNOTS
from ..kernels.forward import forward_kernel
from .checkpoint import INPUTS, Checkpoints
from .recorder import KEPT, check_storage
from .sweep_arena import SweepArena
from .tape_room import Stacks, TapeRoom, new_stacks

if TYPE_CHECKING:
    from ..fused_xpbd import FusedXPBD

__all__ = ["RecordedLaunch"]


@dataclass(frozen=True, eq=False)
class _Part:
    """A part that was run, with its tape, or with what it started from to tape it again.

    Attributes:
        own: by name the arrays of grips, paths and all, and tethers
        masses: inverse masses in lanes, 0 for what was held
        inputs: what the scene was made of, see `INPUTS`
    """

    own: dict[str, np.ndarray]
    masses: np.ndarray
    inputs: dict[str, np.ndarray]
    checkpoint: dict[str, np.ndarray]
    tape: Stacks | None


class RecordedLaunch(ContinuedLaunch):
    """A `ContinuedLaunch` whose parts are recorded while `recording`, under numbers that ascend.

    `sweep` takes one of them back, in any order and as often as asked for: a part knows all that it
    needs. Sweeping touches nothing of the solver; tapes are run again in arrays of their own.

    What scenes are made of (masses, springs, frictions) is taken over when a world begins: later
    changes in the solver wait for the next `begin`.

    Args:
        storage: "full" keeps the tapes of all parts, "replay" checkpoints, "auto" tapes while they
            fit in a quarter of `memory`, and checkpoints from there on. All give the same bits
        memory: most bytes of tapes and checkpoints
        sleep: False leaves the sleep of fabrics out
    """

    def __init__(
        self,
        solver: FusedXPBD,
        substeps: int,
        *,
        storage: str = "auto",
        memory: int = 2**30,
        sleep: bool = True,
    ) -> None:
        super().__init__(solver, substeps)
        self.storage, self.memory, self.sleep = check_storage(storage), memory, sleep
        self.recording = True
        data = self.data
        self._taken = [name for name in INPUTS if name not in self.arrays]
        self.arrays |= {name: data.arrays[name].like() for name in self._taken}
        self._inputs: dict[str, np.ndarray] = {}
        self._edits = -1
        self._checkpoints = Checkpoints(data, self._control, self.arrays)
        self._room = TapeRoom(data, self._control)
        self._parts: dict[int, _Part] = {}
        self._next = 0
        self._stored = 0
        self._checkpoint_bytes = self._own_bytes = 0
        self._needed: tuple[np.ndarray, int] | None = None
        self._spent: list[Stacks] = []
        self._arena: SweepArena | None = None
        self._taped: Any = None
        self.nbytes = 0
        """Most bytes of tapes and checkpoints so far since all parts were freed."""

    @property
    def last(self) -> int:
        """Number of the part that was recorded last."""
        return self._next - 1

    def settings(self, substeps: int) -> Any:
        settings = super().settings(substeps)
        if not self.sleep:
            settings.sleep = 0.0
        return settings

    def free(self) -> None:
        """Free what is recorded: it cannot be swept any more."""
        # fresh memory is dear: tapes are used again
        self._spent += [part.tape for part in self._parts.values() if part.tape is not None]
        self._parts, self._stored, self.nbytes = {}, 0, 0

    # -- running

    def _take_inputs(self) -> None:
        """Take over what the scenes are made of now."""
        self._edits = self.data.edits
        for name in self._taken:
            self.arrays[name].view[...] = self.data.views[name]
        if not self._inputs or any(
            not np.array_equal(self._inputs[name], self.arrays[name].view) for name in self._taken
        ):
            # parts recorded so far keep those that they were run with
            self._inputs = {name: self.arrays[name].view.copy() for name in self._taken}

    def _run_kernel(self, *, begins: bool) -> None:
        if begins or self._edits != self.data.edits:
            self._take_inputs()
        if begins or not self.recording:
            super()._run_kernel(begins=begins)
            return
        checkpoint = self._checkpoints.save()
        own = {name: mirrored.view.copy() for name, mirrored in self.grips.arrays.items()}
        own["particles.tether"] = self.arrays["particles.tether"].view.copy()
        masses = self.data.views["particles.w"].copy()
        self._own_bytes = masses.nbytes + sum(array.nbytes for array in own.values())
        self._checkpoint_bytes = sum(array.nbytes for array in checkpoint.values())
        tape = self._run_taped(checkpoint)
        if tape is None:
            super()._run_kernel(begins=False)
        part = _Part(own, masses, self._inputs, {} if tape else checkpoint, tape)
        self._parts[self._next] = part
        self._next += 1
        self._stored += self._own_bytes
        self._stored += self._checkpoint_bytes if tape is None else tape.nbytes
        self._count(0)

    def check_room(self) -> None:
        """Refuse another part for which there is no memory.

        Raises:
            InputError: there is none.
        """
        if self.recording:
            part = self._sized()[1] if self._keeps() else self._checkpoint_bytes
            self._count(self._own_bytes + part)

    def _sized(self) -> tuple[np.ndarray, int]:
        """Room (groups, 4) that the tape of a part is thought to need, and its bytes."""
        if self._needed is None:
            room = self._room.room(self.substeps)
            self._needed = room, self._room.nbytes(room)
        return self._needed

    def _keeps(self) -> bool:
        """Whether the tape of the next part is kept."""
        if self.storage != "auto":
            return self.storage == "full"
        return self._stored + self._sized()[1] <= KEPT * self.memory

    def _count(self, more: int) -> None:
        """Note the bytes that are in use, with so many `more`; InputError: too many."""
        again = 0 if self._arena is None else self._arena.nbytes
        spent = sum(tape.nbytes for tape in self._spent)
        if self._stored + again + spent + more > self.memory:
            self._spent, spent = [], 0
        total = self._stored + again + spent + more
        self.nbytes = max(self.nbytes, self._room.check(total, self.memory))

    def _run_taped(self, checkpoint: dict[str, np.ndarray]) -> Stacks | None:
        """Run the part with a tape that is kept; None: it is to be run without."""
        while self._keeps():
            tape = self._kept_tape()
            self._launch_taped(tape)
            full = tape.full().any()
            if full or self._room.use is None:
                self._room.learn(tape, np.maximum(tape.read("steps"), 1))
                self._needed = None
            if not full:
                return tape
            self._room.grow(double=True)
            self._checkpoints.restore(checkpoint)
        return None

    def _kept_tape(self) -> Stacks:
        room, nbytes = self._sized()
        while self._spent:
            spent = self._spent.pop()
            if (spent.room >= room).all() and (spent.room <= 4 * room + 64).all():
                return spent
        self._count(nbytes)
        return new_stacks(self.data, self._control, room)

    def _launch_taped(self, tape: Stacks) -> None:
        solver, data = self.solver, self.data
        self._launch(False)  # which looks whether the configuration has changed
        if self._taped is None or self._taped[0] is not self._config:
            kernel = forward_kernel(*data.variant, taped=True)
            inputs = [self.settings(self.substeps), *data.structs(self.arrays)[:-1], tape.struct]
            self._taped = self._config, solver.group_launch(kernel, inputs), len(inputs) - 1
        _, launch, at = self._taped
        tape.struct.resume, tape.struct.last = 1, 0
        launch.set_param_at_index(at, tape.struct)
        self._to_device()
        launch.launch(self.substeps)
        self._to_host()

    # -- sweeping

    def rotations(self, number: int) -> np.ndarray:
        """Rotations of the knots (slots * KNOTS, 4) of a part, flipped to turn the short way."""
        return self._part(number).own["grips.rotation"]

    def _part(self, number: int) -> _Part:
        if number not in self._parts:
            raise InputError(
                "the tape of a control step was freed, by detach() or by the begin() of another "
                "episode: take derivatives before"
            )
        return self._parts[number]

    def sweep(self, number: int, cotangents: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Take a part back: derivatives of a loss by the state before it and by its knots.

        Args:
            cotangents: by arrays of the state after it, as in `Recorder.states`

        Returns:
            As `Recorder.backward`, without parts. Knots of a slot begin at its number times
            `KNOTS`, with where its tip was.

        Raises:
            InputError: the part was freed, or a tape needs more memory than allowed.
        """
        part = self._part(number)
        if self._arena is None:
            self._arena = SweepArena(self, {**self.data.arrays, **self.arrays}, KNOTS)
        arena = self._arena
        arena.set_up(part.inputs, part.own)
        tape = part.tape
        if tape is None:
            tape = arena.tape_again(number, part.checkpoint, self._room, self._fits_again)
        return arena.sweep(tape, part.masses, cotangents, part.inputs)

    def _fits_again(self, nbytes: int) -> None:
        """Refuse a tape to run parts on again for which there is no memory."""
        spent = sum(tape.nbytes for tape in self._spent)
        if self._stored + spent + nbytes > self.memory:
            self._spent = []
        total = self._stored + sum(tape.nbytes for tape in self._spent) + nbytes
        self.nbytes = max(self.nbytes, self._room.check(total, self.memory))
