"""Records a rollout of a solver for differentiation and sweeps derivatives back through it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp

from ...errors import InputError
from ...xpbd.fused_xpbd import FusedXPBD
from ..group_launch import GroupLaunch
from ..guards import WatchValues
from ..kernels.adjoint import adjoint_kernel
from ..kernels.forward import forward_kernel
from ..lanes.tape import COUNTERS, STATE
from ..packing.data import KERNEL_ARGUMENTS
from ..packing.mirrored import Mirrored
from .checkpoint import Checkpoints
from .derivatives import Derivatives
from .sweep_arena import SWEPT, contact_notes
from .tape_room import Stacks, TapeRoom, new_stacks

__all__ = ["KEPT", "STORAGES", "Recorder", "check_storage"]

STORAGES = ("auto", "full", "replay")
KEPT = 0.25
"""Share of `memory` for tapes that "auto" keeps."""
_LONG, _NEAR = 8 * 2**20, 4 * 2**20
"""Bytes of a tape that is kept, and of the one that is used again, where memory allows. A longer
one saves no more launches to speak of, and where it has too little room less is run in vain."""
_READ = ("particles.x", "particles.v", *(f"bodies.{n}" for n in ("x", "q", "v", "omega")))


def check_storage(storage: str) -> str:
    """The storage, if there is such a one.

    Raises:
        InputError: there is none.
    """
    if storage not in STORAGES:
        raise InputError(
            f"storage must be {', '.join(STORAGES[:-1])} or {STORAGES[-1]}, not {storage!r}"
        )
    return storage


@dataclass(frozen=True, eq=False)
class _Segment:
    """Substeps `begin` to `end`, and their tape, or what they started from to tape them again."""

    begin: int
    end: int
    checkpoint: dict[str, Any]
    tape: Stacks | None


class Recorder:
    """A rollout that can be swept back: `forward` first, then any number of `backward`.

    Storage "full" keeps the tapes of all segments of the rollout. "replay" keeps checkpoints, and
    runs each segment again in the sweep with a tape; only the last one is taped at once. "auto"
    keeps tapes while they fit in a quarter of the memory, and checkpoints from there on. All give
    the same bits: the same substeps are taped from the same states. Segments end at the marks at
    which states are asked for.

    Branches (contact or not, side, clamp, stick, release, rest) are those of the forward pass, as
    functions of the state there: the derivative is that of the smooth piece the rollout ran on.

    Sweeping needs nothing of the solver's present state and leaves it as it is: worlds may be
    changed, and other rollouts run, between `forward` and `backward`.

    Args:
        memory: most bytes of checkpoints and tapes; a rollout that does not fit is refused
        sleep: False leaves the sleep of fabrics out, which holds what a derivative should move
        dt: length of a substep [s]; None: the solver's
        damp_every: see `FusedXPBD.run`
    """

    def __init__(
        self,
        solver: FusedXPBD,
        *,
        storage: str = "auto",
        memory: int = 2**30,
        sleep: bool = True,
        dt: float | None = None,
        damp_every: int | None = None,
    ) -> None:
        self.solver, self.storage = solver, check_storage(storage)
        self.memory, self.sleep = memory, sleep
        self.dt, self._damp_every = dt or solver.config.dt, damp_every
        data = solver.data
        self._variant = data.variant
        self._settings = self._new_settings()
        self._segments: list[_Segment] = []
        self._final: dict[str, Any] = {}
        self._inputs: dict[str, Any] = {}
        L, types, device = data.lanes, data.types, data.device
        state = Mirrored(data.group_count * STATE, types.V, device, data.number, (L,))
        counters = Mirrored(data.group_count * COUNTERS, wp.int32, device, np.int32, ())
        self._control = {"state": state, "counters": counters}
        self._notes = contact_notes(data)
        self._no_tape = types.Tape()
        self._no_tape.part = 1
        for name, mirrored in self._control.items():
            setattr(self._no_tape, name, mirrored.array)
        self._room = TapeRoom(data, self._control)
        self._again: Stacks | None = None
        self._on_again: _Segment | None = None
        self._spent: list[Stacks] = []
        self._bound: list[Mirrored] = []
        self._bind()
        self.nbytes = 0
        """Most bytes of tapes and checkpoints that the last rollout had, so far."""

    # -- arrays

    def _bind(self) -> None:
        """Aim the launches at the solver's arrays, some of which a longer path replaces."""
        data = self.solver.data
        bound = list(data.arrays.values())
        if bound == self._bound:
            return
        self._bound = bound
        self._checkpoints = Checkpoints(data, self._control)
        self._derivatives = Derivatives(data)
        self._forward: dict[bool, GroupLaunch] = {}
        swept = [data.struct(name) for name in SWEPT]
        for name, array in self._notes.items():
            setattr(swept[SWEPT.index("contacts")], name, array)
        by = self._derivatives
        self._sweep = self.solver.group_launch(
            adjoint_kernel(*self._variant),
            [self._settings, *swept, self._no_tape, by.by_state, by.by_bodies],
        )

    # -- running

    def forward(self, marks: Sequence[int]) -> list[WatchValues]:
        """Run the rollout that `prepare` has set up, to the last of the `marks`.

        Args:
            marks: ascending numbers of substeps; `states[mark]` is the state after so many: arrays
                "particles.x", "particles.v" as in `SolverData` and poses and twists of bodies

        Raises:
            InputError: the tape needs more memory than allowed.
        """
        data = self.solver.data
        self._marks = [int(m) for m in marks]
        if not self._marks or self._marks[0] < 1 or sorted(set(self._marks)) != self._marks:
            raise InputError(f"marks must be positive ascending substeps, got {list(marks)}")
        data.clear_watch()
        data.to_device()
        self._bind()
        if self._config is not self.solver.config:
            self._settings = self._new_settings()
        self._inputs = self._checkpoints.save_inputs()
        # tapes of the last rollout are used again: fresh memory is dear
        self._spent = [s.tape for s in self._segments if s.tape is not None]
        self._segments, self.states, self._on_again = [], {}, None
        self.nbytes = self._stored = begin = 0
        for mark in self._marks:
            while begin < mark:
                begin = self._run_segment(begin, mark)
            self.states[mark] = self._read()
        self._spent = []
        self._final = self._checkpoints.save()
        data.to_host()
        return self.solver._values()

    def _run_segment(self, begin: int, mark: int) -> int:
        """Run substeps from `begin` on, at most to `mark`; returns where they end."""
        checkpoint = self._checkpoints.save()
        last = self._marks[-1]
        end = min(mark, begin + self._length(_nbytes(checkpoint)))
        keep = self._keeps(end - begin)
        if keep or end == last or self._room.use is None:
            return self._tape_segment(begin, end, checkpoint, keep)
        self._launch(None, begin, end)
        self._append(_Segment(begin, end, checkpoint, None))
        return end

    def _tape_segment(self, begin: int, end: int, checkpoint: dict[str, Any], keep: bool) -> int:
        """Tape substeps `begin` to `end`, or as many as have room; returns where it ends."""
        while True:
            tape = self._kept_tape(end - begin) if keep else self._tape_again(end - begin)
            self._launch(tape, begin, end)
            steps = self._fitted(tape, begin, end)
            if steps is None:
                break
            self._checkpoints.restore(checkpoint)
            end = begin + steps
        self._append(_Segment(begin, end, {} if keep else checkpoint, tape if keep else None))
        if not keep:
            self._on_again = self._segments[-1]
        return end

    def _fitted(self, tape: Stacks, begin: int, end: int) -> int | None:
        """None if all substeps are on the tape that was to hold them, else how many may be."""
        full = tape.full()
        if not full.any():
            self._room.learn(tape, end - begin)
            return None
        steps = int(tape.read("steps")[full].min())
        self._room.grow(double=steps == 0 and end == begin + 1)
        return max(steps, 1)

    def _length(self, checkpoint: int) -> int:
        """Substeps of the next segment: few until it is known how much a substep needs.

        Args:
            checkpoint: bytes of one
        """
        if self._room.use is None:
            return 16
        per_substep, last = self._room.per_substep(), self._marks[-1]
        most = self.memory / 4 / per_substep
        if self.storage == "full":
            return max(8, round(min(last, _LONG / per_substep, most)))
        if self.storage == "auto" and self._stored + _LONG <= KEPT * self.memory:
            return max(8, round(min(_LONG / per_substep, most)))
        # checkpoints and a tape take the least room together when they take as much of it
        least = np.sqrt(last * checkpoint / per_substep)
        return max(8, round(min(max(least, _NEAR / per_substep), most)))

    def _keeps(self, length: int) -> bool:
        """Whether the tape of a segment of so many substeps is kept."""
        if self.storage != "auto":
            return self.storage == "full"
        size = self._room.nbytes(self._room.room(length))
        return self._stored + size <= KEPT * self.memory

    def _append(self, segment: _Segment) -> None:
        self._segments.append(segment)
        self._stored += _nbytes(segment.checkpoint)
        self._stored += 0 if segment.tape is None else segment.tape.nbytes
        self._count(0)

    def _count(self, more: int) -> None:
        """Note the bytes that are in use, with so many `more`; InputError: too many."""
        again = 0 if self._again is None else self._again.nbytes
        self.nbytes = max(self.nbytes, self._room.check(self._stored + again + more, self.memory))

    def _kept_tape(self, length: int) -> Stacks:
        """A tape with room for `length` substeps: one of the last rollout where it suffices.

        Raises:
            InputError: it would need more memory than allowed.
        """
        room = self._room.room(length)
        for spent in self._spent:
            if (spent.room >= room).all() and (spent.room <= 4 * room + 64).all():
                self._spent.remove(spent)
                return spent
        self._count(self._room.nbytes(room))
        return new_stacks(self.solver.data, self._control, room)

    def _tape_again(self, length: int) -> Stacks:
        """The tape on which segments are run again, with room for `length` substeps.

        Raises:
            InputError: it would need more memory than allowed.
        """
        room = self._room.room(length)
        if self._again is not None:
            room = np.maximum(room, self._again.room)
            if (room == self._again.room).all():
                return self._again
        self._again = self._on_again = None
        self._count(self._room.nbytes(room))
        self._again = new_stacks(self.solver.data, self._control, room)
        return self._again

    def _launch(self, tape: Stacks | None, begin: int, end: int) -> None:
        """Run substeps `begin` to `end`; without a tape where it is None."""
        struct, taped = (self._no_tape, False) if tape is None else (tape.struct, True)
        struct.resume, struct.last = int(begin > 0), int(end == self._marks[-1])
        self._settings.max_steps = end
        if taped not in self._forward:
            kernel = forward_kernel(*self._variant, taped=taped)
            inputs = [self._settings, *self.solver.data.structs()[:-1], struct]
            self._forward[taped] = self.solver.group_launch(kernel, inputs)
        launch = self._forward[taped]
        launch.set_param_at_index(0, self._settings)
        launch.set_param_at_index(len(KERNEL_ARGUMENTS), struct)
        launch.launch(end - begin)

    def _new_settings(self) -> Any:
        # one of its own: it is changed here and between launches
        self._config = self.solver.config
        every = self._damp_every or self.solver.damp_every(dt=self.dt)
        settings = self.solver._new_settings(self.solver.config, 0, 0, self.dt, every)
        if not self.sleep:
            settings.sleep = 0.0
        return settings

    def _read(self) -> dict[str, np.ndarray]:
        arrays = self.solver.data.arrays
        for name in _READ:
            arrays[name].to_host()
        return {name: arrays[name].view.copy() for name in _READ}

    # -- sweeping

    def backward(
        self, cotangents: Mapping[int, Mapping[str, np.ndarray]], *, parts: bool = True
    ) -> dict[str, np.ndarray]:
        """Derivatives of a loss by the start of the rollout and its parameters.

        Args:
            cotangents: by mark, derivatives of the loss by the arrays of `states` there
            parts: whether those by single particles and springs are wanted, which take longer:
                without, "mass", "radius", "spring_stiffness" and "rest" are not numbers

        Returns:
            Copies: "x", "v" (by the state at the start), "mass" (by inverse masses), "radius" (of
            particles); by spring of a group (see `spring_rows`) "spring_stiffness" and
            "rest" (length); per group "damping", "table_friction", "contact_friction", "stiffness";
            per knot "position", "rotation", "time"; "fired" (groups, kinds, L): how often
            constraints acted. Per body "body.x", "body.q" (by the four numbers), "body.v",
            "body.omega", "body.w".
        """
        if not self._segments:
            raise InputError("there is nothing to sweep back: call forward first")
        unknown = set(cotangents) - set(self._marks)
        if unknown:
            raise InputError(f"no marks {sorted(unknown)}: the rollout was marked at {self._marks}")
        checkpoints = self._checkpoints
        now, inputs = checkpoints.save(), checkpoints.save_inputs()
        checkpoints.restore_inputs(self._inputs)
        checkpoints.restore(self._final)
        self._derivatives.by_state.parts = int(parts)
        self._sweep_segments(cotangents)
        checkpoints.restore_inputs(inputs)
        checkpoints.restore(now)
        return self._derivatives.read(self._inputs, self.dt, parts=parts)

    def _sweep_segments(self, cotangents: Mapping[int, Mapping[str, np.ndarray]]) -> None:
        by, sweep = self._derivatives, self._sweep
        by.clear(self._final["particles.w"])
        number = len(self._segments) - 1
        while number >= 0:
            number, tape = self._tape_of(number)
            segment = self._segments[number]
            if segment.end in cotangents:
                by.add(cotangents[segment.end])
            by.by_state.leave = int(segment.begin > 0 and segment.begin not in self._marks)
            self._settings.max_steps = segment.end
            for at, value in (
                (0, self._settings),
                (1 + len(SWEPT), tape.struct),
                (2 + len(SWEPT), by.by_state),
            ):
                sweep.set_param_at_index(at, value)
            sweep.launch(segment.end - segment.begin)
            number -= 1

    def _tape_of(self, number: int) -> tuple[int, Stacks]:
        """The tape of a segment, and its number: of what takes more room than it was thought to
        take only the end is taped, as a segment of its own.
        """
        while True:
            segment = self._segments[number]
            if segment.tape is not None:
                return number, segment.tape
            if self._on_again is segment and self._again is not None:
                return number, self._again
            begin, end = segment.begin, segment.end
            length = self._length(_nbytes(segment.checkpoint))
            tape = self._tape_again(min(end - begin, length))
            self._checkpoints.restore(segment.checkpoint)
            self._launch(tape, begin, end)
            steps = self._fitted(tape, begin, end)
            if steps is None:
                self._on_again = segment
                return number, tape
            self._on_again = None
            if steps < end - begin:
                self._checkpoints.restore(segment.checkpoint)
                self._launch(None, begin, begin + steps)
                later = _Segment(begin + steps, end, self._checkpoints.save(), None)
                self._segments[number : number + 1] = [replace(segment, end=begin + steps), later]
                self._stored += _nbytes(later.checkpoint)
                number += 1


def _nbytes(saved: dict[str, np.ndarray]) -> int:
    return sum(array.nbytes for array in saved.values())
