"""Records a rollout of a solver for differentiation and sweeps derivatives back through it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from ...errors import InputError
from ...xpbd.fused_xpbd import FusedXPBD
from ..bodies.body_contact import VISIT
from ..bodies.body_sweeps import VISITS
from ..guards import WatchValues
from ..kernels.adjoint import adjoint_kernel
from ..kernels.forward import forward_kernel
from ..lanes.tape import COUNTERS, STATE, Kind
from ..packing.data import KERNEL_ARGUMENTS
from ..packing.mirrored import Mirrored
from ..springs.viscosity import DAMP_EVERY
from .checkpoint import Checkpoints
from .tape_room import Stacks, TapeRoom, new_stacks

__all__ = ["Recorder"]

_NEAR = 4 * 2**20  # bytes of a tape that is replayed, where memory allows
_SWEPT = ("topology", "springs", "pairs", "shapes", "group", "particles", "bodies", "contacts",
          "grips", "sheets", "lines")  # fmt: skip
_BODY = ("x", "q", "v", "omega")
_READ = ("particles.x", "particles.v", *(f"bodies.{n}" for n in _BODY))
_ADJOINT_OF = {"particles.x": "x", "particles.v": "v"} | {f"bodies.{n}": f"body.{n}" for n in _BODY}


@dataclass(eq=False)
class _Segment:
    """Substeps `begin` to `end`, what they started from, and where they are taped."""

    begin: int
    end: int
    checkpoint: dict[str, Any]
    tape: Stacks


class Recorder:
    """A rollout that can be swept back: `forward` first, then any number of `backward`.

    storage "replay" keeps checkpoints and one segment's tape and runs each segment again in the
    sweep, "full" keeps all tapes. Both give the same bits: the same substeps are taped from the
    same states. Segments end at the marks at which states are asked for.

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
        storage: str = "replay",
        memory: int = 2**30,
        sleep: bool = True,
        dt: float | None = None,
        damp_every: int = DAMP_EVERY,
    ) -> None:
        if storage not in ("replay", "full"):
            raise InputError(f"storage must be replay or full, not {storage!r}")
        self.solver, self.storage, self.memory, self.sleep = solver, storage, memory, sleep
        self.dt, self.damp_every = dt or solver.config.dt, damp_every
        data = solver.data
        variant = (data.scalar, data.lanes, bool(data.has_bodies), data.has_sheets, data.has_edges)
        variant += (data.has_lines,)
        self._kernels = forward_kernel(*variant, taped=True), adjoint_kernel(*variant)
        self._settings = self._new_settings()
        self._segments: list[_Segment] = []
        self._final: dict[str, Any] = {}
        self._inputs: dict[str, Any] = {}
        self._control = {
            "state": self._mirrored(data.group_count * STATE, data.types.V, (data.lanes,)),
            "counters": Mirrored(data.group_count * COUNTERS, wp.int32, data.device, np.int32, ()),
        }
        contacts = len(data.arrays["contacts.mu"].view)
        self._notes = {
            "code": wp.zeros(contacts, dtype=wp.vec4i, device=data.device),
            "visit": wp.zeros(contacts * VISITS, dtype=wp.vec2i, device=data.device),
            "log": wp.zeros(contacts * VISITS * VISIT, dtype=data.scalar, device=data.device),
        }
        self._room = TapeRoom(data, self._control)
        self._tape: Stacks | None = None
        self._spent: list[Stacks] = []
        self._bound: list[Mirrored] = []
        self._bind()
        self.nbytes = 0
        """Bytes of the tapes and checkpoints of the last rollout."""

    # -- arrays

    def _bind(self) -> None:
        """Aim the launches at the solver's arrays, some of which a longer path replaces."""
        data = self.solver.data
        bound = list(data.arrays.values())
        if bound == self._bound:
            return
        self._bound = bound
        self._checkpoints = Checkpoints(data, self._control)
        self._adjoint = self._new_adjoint()
        self._forward = self.solver.group_launch(
            self._kernels[0], [self._settings, *data.structs()[:-1], data.types.Tape()]
        )
        self._by_state, by_bodies = self._adjoint_structs()
        swept = [data.struct(name) for name in _SWEPT]
        for name, array in self._notes.items():
            setattr(swept[_SWEPT.index("contacts")], name, array)
        self._sweep = self.solver.group_launch(
            self._kernels[1],
            [self._settings, *swept, data.types.Tape(), self._by_state, by_bodies],
        )

    def _mirrored(self, count: int, dtype: Any, shape: tuple[int, ...]) -> Mirrored:
        data = self.solver.data
        return Mirrored(count, dtype, data.device, data.number, shape)

    def _new_adjoint(self) -> dict[str, Mirrored]:
        data = self.solver.data
        t, L, groups = data.types, data.lanes, data.group_count
        particles, knots = int(data.group_particle[-1]), data.knot_room
        arrays = {name: self._mirrored(particles, t.V3, (3, L)) for name in ("x", "v", "xp")}
        scratch = ("then_x", "then_v", "then_g", "then_h")
        arrays |= {name: self._mirrored(particles, t.V3, (3, L)) for name in scratch}
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
        for name in (
            "ra",
            "rb",
            "normal",
            "across_u",
            "across_v",
            "weights",
            "upper",
            "steps",
            "impulse",
        ):
            arrays[f"body.{name}"] = self._mirrored(contacts, t.R3, (3,))
        arrays["body.mu"] = self._mirrored(contacts, t.S, ())
        return arrays

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
        self._settings = self._new_settings()
        self._inputs = self._checkpoints.save_inputs()
        # tapes of the last rollout are used again: fresh memory is dear
        self._spent = [segment.tape for segment in self._segments]
        self._segments, self.states = [], {}
        self._stored, self._on_tape = 0, -1
        begin, last = 0, self._marks[-1]
        while begin < last:
            mark = next(m for m in self._marks if m > begin)
            begin = self._record_segment(begin, min(mark, begin + self._length(last)), last)
            if begin == mark:
                self.states[mark] = self._read()
        self._final = self._checkpoints.save()
        data.to_host()
        return self.solver._values()

    def _record_segment(self, begin: int, end: int, last: int) -> int:
        """Tape substeps `begin` to `end`, or as many as have room; returns where it ends."""
        checkpoint = self._checkpoints.save()
        while True:
            tape = self._tape_for(end - begin)
            self._launch(tape, begin, end, end == last)
            full = tape.full()
            if not full.any():
                break
            steps = int(tape.arrays["steps"].numpy()[full].min())
            self._room.grow(double=steps == 0 and end == begin + 1)
            self._checkpoints.restore(checkpoint)
            end = begin + max(steps, 1)
        self._room.learn(tape, end - begin)
        self._stored += _nbytes(checkpoint) + (tape.nbytes if self.storage == "full" else 0)
        self._segments.append(_Segment(begin, end, checkpoint, tape))
        self._on_tape = len(self._segments) - 1
        return end

    def _length(self, last: int) -> int:
        """Substeps of the next segment: few until it is known how much a substep needs."""
        if self._room.use is None:
            return 16
        if self.storage == "full":
            return last
        if not self._segments:
            return 16
        per_substep = self._room.per_substep()
        least = round(np.sqrt(last * self._stored / len(self._segments) / per_substep))
        # every segment costs a launch and a checkpoint: a tape that the processor's cache holds is
        # no dearer when it is long
        return max(
            8, min(max(least, round(_NEAR / per_substep)), round(self.memory / 4 / per_substep))
        )

    def _tape_for(self, length: int) -> Stacks:
        """A tape with room for `length` substeps: one that is in use already where it suffices.

        Raises:
            InputError: it would need more memory than allowed.
        """
        room = self._room.room(length)
        replay = self.storage == "replay"
        for spent in () if replay else self._spent:
            if (spent.room >= room).all() and (spent.room <= 4 * room + 64).all():
                self._spent.remove(spent)
                return spent
        if replay and self._tape is not None:
            room = np.maximum(room, self._tape.room)
            if (room == self._tape.room).all():
                return self._tape
        self.nbytes = self._room.check(room, self._stored, self.memory)
        tape = new_stacks(self.solver.data, self._control, room)
        if replay:
            self._tape = tape
        return tape

    def _launch(self, tape: Stacks, begin: int, end: int, last: bool) -> None:
        tape.struct.resume, tape.struct.last = int(begin > 0), int(last)
        self._settings.max_steps = end
        self._forward.set_param_at_index(0, self._settings)
        self._forward.set_param_at_index(len(KERNEL_ARGUMENTS), tape.struct)
        self._forward.launch(end - begin)

    def _new_settings(self) -> Any:
        # one of its own: it is changed here and between launches
        settings = self.solver._new_settings(self.solver.config, 0, 0, self.dt, self.damp_every)
        if not self.sleep:
            settings.sleep = 0.0
        return settings

    def _read(self) -> dict[str, np.ndarray]:
        arrays = self.solver.data.arrays
        for name in _READ:
            arrays[name].to_host()
        return {name: arrays[name].view.copy() for name in _READ}

    # -- sweeping

    def backward(self, cotangents: Mapping[int, Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
        """Derivatives of a loss by the start of the rollout and its parameters.

        Args:
            cotangents: by mark, derivatives of the loss by the arrays of `states` there

        Returns:
            Views, valid until the next call: "x", "v" (by the state at the start), "mass" (by
            inverse masses), per group "damping", "table_friction", "contact_friction", "stiffness";
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
        self._sweep_segments(cotangents)
        checkpoints.restore_inputs(inputs)
        checkpoints.restore(now)
        return self._derivatives()

    def _sweep_segments(self, cotangents: Mapping[int, Mapping[str, np.ndarray]]) -> None:
        adjoint, sweep = self._adjoint, self._sweep
        for mirrored in adjoint.values():
            mirrored.view[...] = 0
        adjoint["w"].view[...] = self._final["particles.w"]
        for mirrored in adjoint.values():
            mirrored.to_device()
        struct = self._by_state
        for number in reversed(range(len(self._segments))):
            segment = self._segments[number]
            if segment.end in cotangents:
                self._add(cotangents[segment.end])
            tape = self._replay(number) if self.storage == "replay" else segment.tape
            struct.leave = int(segment.begin > 0 and segment.begin not in self._marks)
            self._settings.max_steps = segment.end
            for at, value in (
                (0, self._settings),
                (1 + len(_SWEPT), tape.struct),
                (2 + len(_SWEPT), struct),
            ):
                sweep.set_param_at_index(at, value)
            sweep.launch(segment.end - segment.begin)

    def _derivatives(self) -> dict[str, np.ndarray]:
        for mirrored in self._adjoint.values():
            mirrored.to_host()
        out = {name: mirrored.view.copy() for name, mirrored in self._adjoint.items()}
        data, dt = self.solver.data, self.dt
        damping, stiffness = (self._inputs[f"group.{n}"] for n in ("damping", "stiffness"))
        # what is pinned has no mass to derive by
        out["body.w"] *= self._inputs["bodies.w0"] > 0.0
        out["damping"] *= np.where(damping * dt < 1.0, -dt, 0.0)
        out["stiffness"] *= -1.0 / (stiffness * dt) ** 2
        out["fired"] = out["fired"].reshape(data.group_count, len(Kind), data.lanes)
        return out

    def _replay(self, number: int) -> Stacks:
        """The tape of a segment, made anew unless it is the one on the tape."""
        segment, tape = self._segments[number], self._tape
        assert tape is not None
        if self._on_tape != number:
            self._checkpoints.restore(segment.checkpoint)
            self._launch(tape, segment.begin, segment.end, number == len(self._segments) - 1)
            assert not tape.full().any()
            self._on_tape = number
        return tape

    def _add(self, cotangent: Mapping[str, np.ndarray]) -> None:
        for name, values in cotangent.items():
            mirrored = self._adjoint[_ADJOINT_OF[name]]
            mirrored.to_host()
            mirrored.view[...] += values
            mirrored.to_device()

    def _adjoint_structs(self) -> tuple[Any, Any]:
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
