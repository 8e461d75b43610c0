"""Records a rollout of a solver for differentiation and sweeps derivatives back through it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..errors import InputError
from .adjoint import adjoint_kernel
from .body_contact import PASSES, VISIT
from .checkpoint import Checkpoints
from .data import KERNEL_ARGUMENTS
from .forward import forward_kernel
from .mirrored import Mirrored
from .tape import (
    BODY_SCALARS,
    BODY_WORDS,
    BOX_TRIANGLE_SCALARS,
    COUNTERS,
    GRIP_WORDS,
    STATE,
    TRIANGLE_SCALARS,
    TRIANGLE_WORDS,
    Kind,
)

if TYPE_CHECKING:
    from .guards import WatchValues
    from .solver import SolverFusedXPBD

__all__ = ["Recorder"]

_NEAR = 4 * 2**20  # bytes of a tape that is replayed, where memory allows
_MOST = 2**31 - 1  # elements of one stack: whole numbers of 32 bits count them
_ORDER = KERNEL_ARGUMENTS
_SWEPT = ("topology", "springs", "pairs", "shapes", "group", "particles", "bodies", "contacts",
          "grips", "sheets")  # fmt: skip
_BODY = ("x", "q", "v", "omega")
_ADJOINT_OF = {"particles.x": "x", "particles.v": "v"} | {f"bodies.{n}": f"body.{n}" for n in _BODY}


@dataclass(frozen=True, eq=False)
class _Tape:
    """Stacks of one segment of the rollout: room (groups, 4) elements of x, v, k and s."""

    struct: Any
    room: np.ndarray
    arrays: dict[str, Any]
    nbytes: int


@dataclass(eq=False)
class _Segment:
    """Substeps `begin` to `end`, what they started from, and where they are taped."""

    begin: int
    end: int
    checkpoint: dict[str, Any] | None
    tape: _Tape


class Recorder:
    """A rollout that can be swept back: `forward` first, then any number of `backward`.

    storage "replay" keeps checkpoints and one segment's tape and runs each segment again in the
    sweep, "full" keeps all tapes. Both give the same bits: the same substeps are taped from the
    same states. Segments end at the marks at which states are asked for.

    memory: most bytes of checkpoints and tapes; a rollout that does not fit is refused.
    sleep: False leaves dry friction and sleep of fabrics out: they hold what a derivative should
    move.

    Branches (contact or not, side, clamp, stick, release, rest) are those of the forward pass, as
    functions of the state there: the derivative is that of the smooth piece the rollout ran on.
    """

    def __init__(
        self,
        solver: SolverFusedXPBD,
        *,
        storage: str = "replay",
        memory: int = 2**30,
        sleep: bool = True,
    ) -> None:
        if storage not in ("replay", "full"):
            raise InputError(f"storage must be replay or full, not {storage!r}")
        self.solver, self.storage, self.memory, self.sleep = solver, storage, memory, sleep
        data = solver.data
        variant = (
            data.scalar, data.lanes, bool(data.has_bodies), data.has_sheets, data.has_edges
        )  # fmt: skip
        self._forward = forward_kernel(*variant, taped=True)
        self._sweep = adjoint_kernel(*variant)
        self._segments: list[_Segment] = []
        self._final: dict[str, Any] = {}
        self._control = {
            "state": self._mirrored(data.group_count * STATE, data.types.V, (data.lanes,)),
            "counters": Mirrored(data.group_count * COUNTERS, wp.int32, data.device, np.int32, ()),
        }
        self._checkpoints = Checkpoints(data, self._control)
        self._adjoint = self._new_adjoint()
        contacts = len(data.arrays["contacts.mu"].view)
        self._notes = {
            "code": wp.zeros(contacts, dtype=wp.vec4i, device=data.device),
            "log": wp.zeros(contacts * PASSES * VISIT, dtype=data.scalar, device=data.device),
        }
        self._tape: _Tape | None = None
        self._spent: list[_Tape] = []
        self._use: np.ndarray | None = None
        self._spare = 2.0 * self._least_room() + self._solid_room()
        self.nbytes = 0
        """Bytes of the tapes and checkpoints of the last rollout."""

    # -- arrays

    def _mirrored(self, count: int, dtype: Any, shape: tuple[int, ...]) -> Mirrored:
        data = self.solver.data
        return Mirrored(count, dtype, data.device, data.number, shape)

    def _new_adjoint(self) -> dict[str, Mirrored]:
        data = self.solver.data
        t, L, groups = data.types, data.lanes, data.group_count
        particles, knots = int(data.group_particle[-1]), data.knot_room
        arrays = {name: self._mirrored(particles, t.V3, (3, L)) for name in ("x", "v", "xp")}
        arrays |= {name: self._mirrored(particles, t.V, (L,)) for name in ("w", "mass")}
        for name in ("damping", "table_friction", "contact_friction", "stiffness"):
            arrays[name] = self._mirrored(groups, t.V, (L,))
        arrays["time"] = self._mirrored(knots, t.S, ())
        arrays["position"] = self._mirrored(knots, t.R3, (3,))
        arrays["rotation"] = self._mirrored(knots, t.Q, (4,))
        arrays["shift"] = self._mirrored(groups * L, t.R3, (3,))
        arrays["pending"] = Mirrored(groups, wp.int32, data.device, np.int32, ())
        arrays["fired"] = self._mirrored(groups * len(Kind), t.V, (L,))
        bodies, contacts = int(data.group_body[-1]), len(data.arrays["contacts.mu"].view)
        for name in ("x", "v", "omega", "xp", "dx", "dr"):
            arrays[f"body.{name}"] = self._mirrored(bodies, t.R3, (3,))
        for name in ("q", "qp"):
            arrays[f"body.{name}"] = self._mirrored(bodies, t.Q, (4,))
        arrays["body.w"] = self._mirrored(bodies, t.S, ())
        arrays["body.spread"] = self._mirrored(bodies, t.M33, (3, 3))
        for name in ("ra", "rb", "normal", "across_u", "across_v", "weights", "steps", "impulse"):
            arrays[f"body.{name}"] = self._mirrored(contacts, t.R3, (3,))
        arrays["body.mu"] = self._mirrored(contacts, t.S, ())
        return arrays

    def _new_tape(self, room: np.ndarray) -> _Tape:
        """Stacks with room (groups, 4) for so many elements."""
        data = self.solver.data
        t, device = data.types, data.device
        struct = t.Tape()
        end = np.cumsum(room, axis=0)
        arrays: dict[str, Any] = {}
        for column, (name, dtype) in enumerate(
            (("x", t.V3), ("v", t.V), ("k", wp.int32), ("s", t.S))
        ):
            arrays[name] = wp.empty(max(int(end[-1, column]), 1), dtype=dtype, device=device)
        arrays["first"] = wp.array((end - room).astype(np.int32), dtype=wp.vec4i, device=device)
        arrays["end"] = wp.array(end.astype(np.int32), dtype=wp.vec4i, device=device)
        arrays["top"] = wp.zeros(data.group_count, dtype=wp.vec4i, device=device)
        for name in ("steps", "until", "full"):
            arrays[name] = wp.zeros(data.group_count, dtype=wp.int32, device=device)
        for name, mirrored in self._control.items():
            arrays[name] = mirrored.array
        flat = wp.array(
            ptr=arrays["x"].ptr, dtype=data.scalar,
            shape=(arrays["x"].capacity // np.dtype(data.number).itemsize,), device=device,
        )  # fmt: skip
        for name, array in (*arrays.items(), ("x_flat", flat)):
            setattr(struct, name, array)
        return _Tape(struct, room, arrays, int((room @ self._sizes()).sum()))

    def _sizes(self) -> np.ndarray:
        """Bytes of an element of each stack."""
        data = self.solver.data
        scalar = np.dtype(data.number).itemsize
        return np.array([3 * data.lanes * scalar, data.lanes * scalar, 4, scalar])

    def _least_room(self) -> np.ndarray:
        """Room (groups, 4) that any substep needs; contacts come on top."""
        data, rows = self.solver.data, []
        for k in data.group_topology:
            top = data.topologies[k]
            springs, particles = len(top.spring_ij), top.particle_count
            words = springs + particles + 2 * data.lanes * (GRIP_WORDS + 4) + 8
            bodies = top.body_count * data.lanes
            words += BODY_WORDS * bodies
            rows.append((2 * springs + 4 * particles, particles + 8, words, BODY_SCALARS * bodies))
        return np.array(rows)

    def _solid_room(self) -> np.ndarray:
        """Room (groups, 4) that contacts of boxes with particles and triangles may need."""
        data, rows = self.solver.data, []
        for k in data.group_topology:
            top = data.topologies[k]
            solid = len(top.shape_body) * (top.particle_count + len(top.sheet_triangle))
            solid *= data.lanes
            rows.append((0, 0, BODY_WORDS * solid, BOX_TRIANGLE_SCALARS * solid))
        return np.array(rows)

    # -- running

    def forward(self, marks: Sequence[int]) -> list[WatchValues]:
        """Run the rollout that `prepare` has set up, to the last of the `marks`.

        marks: ascending numbers of substeps; `states[mark]` is the state after so many: arrays
        "particles.x", "particles.v" as in `SolverData` and poses and twists of bodies.

        Raises:
            InputError: the tape needs more memory than allowed.
        """
        data = self.solver.data
        self._marks = [int(m) for m in marks]
        if not self._marks or self._marks[0] < 1 or sorted(set(self._marks)) != self._marks:
            raise InputError(f"marks must be positive ascending substeps, got {list(marks)}")
        for name in ("steps", "nonfinite", "stretch", "depth", "clamped", "overflow"):
            data.arrays[f"watch.{name}"].view[...] = 0
        for mirrored in data.arrays.values():
            mirrored.to_device()
        self._structs = data.structs()[:-1]
        if len(self._adjoint["time"].view) != max(data.knot_room, 1):
            self._adjoint = self._new_adjoint()
        # tapes of the last rollout are used again: fresh memory is dear
        self._spent = [segment.tape for segment in self._segments]
        self._segments, self.states = [], {}
        self._kept, self._on_tape = 0, -1
        begin, last = 0, self._marks[-1]
        while begin < last:
            mark = next(m for m in self._marks if m > begin)
            begin = self._record_segment(begin, min(mark, begin + self._length(last)), last)
            if begin == mark:
                self.states[mark] = self._read()
        self._final = self._checkpoints.save()
        for mirrored in data.arrays.values():
            mirrored.to_host()
        return self.solver._values()

    def _record_segment(self, begin: int, end: int, last: int) -> int:
        """Tape substeps `begin` to `end`, or as many as have room; returns where it ends."""
        checkpoint = self._checkpoints.save()
        while True:
            tape = self._tape_for(end - begin)
            self._launch(tape, begin, end, end == last)
            full = tape.arrays["full"].numpy() > 0
            if not full.any():
                break
            steps = int(tape.arrays["steps"].numpy()[full].min())
            self._spare = np.maximum(self._spare, self._worst())
            self._checkpoints.restore(checkpoint)
            if steps == 0 and end == begin + 1:
                self._spare = 2 * self._spare
            end = begin + max(steps, 1)
        self._learn(tape, end - begin)
        self._kept += _nbytes(checkpoint) + (tape.nbytes if self.storage == "full" else 0)
        self._segments.append(_Segment(begin, end, checkpoint, tape))
        self._on_tape = len(self._segments) - 1
        return end

    def _length(self, last: int) -> int:
        """Substeps of the next segment: few until it is known how much a substep needs."""
        if self._use is None:
            return 16
        if self.storage == "full":
            return last
        if not self._segments:
            return 16
        per_substep = float((self._use * self._sizes()).sum())
        least = round(np.sqrt(last * self._kept / len(self._segments) / per_substep))
        # every segment costs a launch and a checkpoint: a tape that the processor's cache holds is
        # no dearer when it is long
        return max(
            8, min(max(least, round(_NEAR / per_substep)), round(self.memory / 4 / per_substep))
        )

    def _tape_for(self, length: int) -> _Tape:
        """A tape with room for `length` substeps: the one in use where it suffices.

        Raises:
            InputError: it would need more memory than allowed.
        """
        use = self._least_room() if self._use is None else 1.1 * self._use
        room = np.ceil(use * length + self._spare).astype(int)
        largest = int((room.sum(axis=0) * (self._sizes() > 0)).max())
        replay = self.storage == "replay"
        for spent in () if replay else self._spent:
            if (spent.room >= room).all() and (spent.room <= 4 * room + 64).all():
                self._spent.remove(spent)
                return spent
        if replay and self._tape is not None:
            room = np.maximum(room, self._tape.room)
            if (room == self._tape.room).all():
                return self._tape
        self.nbytes = self._kept + int((room * self._sizes()).sum())
        if self.nbytes > self.memory or largest > _MOST:
            raise InputError(
                f"the tape would need {self.nbytes} bytes of {self.memory}: allow more memory, use "
                'storage="replay", or record fewer worlds at once'
            )
        tape = self._new_tape(room)
        if replay:
            self._tape = tape
        return tape

    def _learn(self, tape: _Tape, steps: int) -> None:
        """How much of the tape a substep takes."""
        used = (tape.arrays["top"].numpy() - tape.arrays["first"].numpy()) / steps
        self._use = used if self._use is None else np.maximum(self._use, used)
        self._spare = np.maximum(self._spare, self._worst())

    def _worst(self) -> np.ndarray:
        """How much of the tape (groups, 4) a substep takes at worst with the lists as they are."""
        data = self.solver.data
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
        return (
            self._least_room()
            + self._solid_room()
            + 1.5
            * np.stack(
                [2 * near, near, near + TRIANGLE_WORDS * listed, TRIANGLE_SCALARS * listed], axis=1
            )
        )

    def _launch(self, tape: _Tape, begin: int, end: int, last: bool) -> None:
        tape.struct.resume, tape.struct.last = int(begin > 0), int(last)
        wp.launch(
            self._forward, dim=self.solver.data.group_count,
            inputs=[self._settings(end), *self._structs, tape.struct],
            device=self.solver.model.device,
        )  # fmt: skip

    def _settings(self, steps: int) -> Any:
        settings = self.solver._settings(steps, 0)
        if not self.sleep:
            settings.dry = settings.sleep = 0.0
        return settings

    def _read(self) -> dict[str, np.ndarray]:
        data = self.solver.data
        names = [f"particles.{n}" for n in ("x", "v")]
        names += [f"bodies.{n}" for n in ("x", "q", "v", "omega")]
        for name in names:
            data.arrays[name].to_host()
        return {name: data.arrays[name].view.copy() for name in names}

    # -- sweeping

    def backward(self, cotangents: Mapping[int, Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
        """Derivatives of a loss by the start of the rollout and its parameters.

        cotangents: by mark, derivatives of the loss by the arrays of `states` there

        Returns views, valid until the next call: "x", "v" (by the state at the start), "mass" (by
        inverse masses), per group "damping", "table_friction", "contact_friction", "stiffness";
        per knot "position", "rotation", "time"; "fired" (groups, kinds, L): how often constraints
        acted. Per body "body.x", "body.q" (by the four numbers), "body.v", "body.omega", "body.w".
        """
        if not self._segments:
            raise InputError("there is nothing to sweep back: call forward first")
        unknown = set(cotangents) - set(self._marks)
        if unknown:
            raise InputError(f"no marks {sorted(unknown)}: the rollout was marked at {self._marks}")
        data, adjoint = self.solver.data, self._adjoint
        for mirrored in adjoint.values():
            mirrored.view[...] = 0
        adjoint["w"].view[...] = self._final["particles.w"]
        struct, of_bodies = self._adjoint_struct()
        inputs = [self._structs[_ORDER.index(n)] for n in _SWEPT]
        for name, array in self._notes.items():
            setattr(inputs[_SWEPT.index("contacts")], name, array)
        for mirrored in adjoint.values():
            mirrored.to_device()
        for number in reversed(range(len(self._segments))):
            segment = self._segments[number]
            if segment.end in cotangents:
                self._add(cotangents[segment.end])
            tape = segment.tape
            if self.storage == "replay":
                tape = self._replay(number)
            struct.leave = int(segment.begin > 0 and segment.begin not in self._marks)
            wp.launch(
                self._sweep, dim=data.group_count,
                inputs=[self._settings(segment.end), *inputs, tape.struct, struct, of_bodies],
                device=self.solver.model.device,
            )  # fmt: skip
        for mirrored in adjoint.values():
            mirrored.to_host()
        self._checkpoints.restore(self._final)
        out = {name: mirrored.view.copy() for name, mirrored in adjoint.items()}
        views, dt = data.views, self.solver.config.dt
        # what is pinned has no mass to derive by
        out["body.w"] *= data.views["bodies.w0"] > 0.0
        out["damping"] *= np.where(views["group.damping"] * dt < 1.0, -dt, 0.0)
        out["stiffness"] *= -1.0 / (views["group.stiffness"] * dt) ** 2
        out["fired"] = out["fired"].reshape(data.group_count, len(Kind), data.lanes)
        return out

    def _replay(self, number: int) -> _Tape:
        """The tape of a segment, made anew unless it is the one on the tape."""
        segment, tape = self._segments[number], self._tape
        assert tape is not None
        if self._on_tape != number:
            self._checkpoints.restore(segment.checkpoint)
            last = number == len(self._segments) - 1
            self._launch(tape, segment.begin, segment.end, last)
            assert not tape.arrays["full"].numpy().any()
            self._on_tape = number
        return tape

    def _add(self, cotangent: Mapping[str, np.ndarray]) -> None:
        for name, values in cotangent.items():
            mirrored = self._adjoint[_ADJOINT_OF[name]]
            mirrored.to_host()
            mirrored.view[...] += values
            mirrored.to_device()

    def _adjoint_struct(self) -> tuple[Any, Any]:
        data = self.solver.data
        struct, of_bodies = data.types.Adjoint(), data.types.BodyAdjoint()
        for name, mirrored in self._adjoint.items():
            owner, _, field = name.rpartition(".")
            setattr(of_bodies if owner else struct, field, mirrored.array)
        for name in ("x", "xp", "w", "mass"):
            array = self._adjoint[name].array
            count = array.capacity // np.dtype(data.number).itemsize
            flat = wp.array(ptr=array.ptr, dtype=data.scalar, shape=(count,), device=array.device)
            setattr(struct, f"{name}_flat", flat)
        return struct, of_bodies


def _nbytes(saved: dict[str, np.ndarray]) -> int:
    return sum(array.nbytes for array in saved.values())
