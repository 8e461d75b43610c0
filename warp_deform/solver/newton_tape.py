"""Steps on a `wp.Tape`: Newton's way of differentiating, with the solver's own adjoint.

The solver's kernels have no adjoint that Warp could generate, so a step that is taken while a tape
records leaves one function there, which adds the derivatives by `state_in` to its gradients.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import newton
import numpy as np
import warp as wp

from ..errors import InputError, WarpDeformError
from ..rollout.differentiable import DifferentiableRollout
from ..rollout.rollouts import GripPath
from ..xpbd.fused_xpbd import FusedXPBD
from ..xpbd.guards import WatchValues

__all__ = ["TapedStep", "recording", "refuse_lost_derivatives", "unrecorded"]

STATE = ("particle_q", "particle_qd", "body_q", "body_qd")


def _runtime() -> Any:
    """Warp's own state, whose `tape` is the one that records; it has no public name.

    Raises:
        WarpDeformError: this version of Warp keeps it elsewhere, so that nobody could tell whether
            derivatives are asked for.
    """
    wp.init()
    runtime = getattr(getattr(getattr(wp, "_src", None), "context", None), "runtime", None)
    if not hasattr(runtime, "tape"):
        raise WarpDeformError(
            f"warp-lang {wp.__version__} does not say which tape records; install the version in "
            "constraints.txt"
        )
    return runtime


def recording() -> Any:
    """The `wp.Tape` that records now, or None."""
    return _runtime().tape


@contextmanager
def unrecorded() -> Iterator[None]:
    """What is done in here is on no tape."""
    runtime = _runtime()
    tape, runtime.tape = runtime.tape, None
    try:
        yield
    finally:
        runtime.tape = tape


def refuse_lost_derivatives(state: newton.State) -> None:
    """Refuse to write a state by a way that leaves no derivative on the tape that records.

    Raises:
        InputError: a tape records, and the state asks for gradients.
    """
    if recording() is not None and _by_name(state, gradients=True):
        raise InputError(
            "write_state leaves no derivatives on the wp.Tape that records: use step, or "
            "DifferentiableRollout, or a state without requires_grad"
        )


class TapedStep:
    """One step of all worlds of a solver, on the tape: called, it takes the derivatives back.

    Derivatives are those by what has requires_grad: positions and velocities of particles and
    bodies in `state_in`, and `grip_target` of the control. They add up in `grad`, as Warp's.
    """

    def __init__(
        self,
        solver: FusedXPBD,
        state_in: newton.State,
        state_out: newton.State,
        control: Any,
    ) -> None:
        """Take the arrays; control: the solver's own attributes of a control, or None.

        Raises:
            InputError: derivatives would be lost, or be those of overwritten states.
        """
        self._solver = solver
        self._runs: list[tuple[list[int], DifferentiableRollout, dict[int, GripPath]]] = []
        self._read, self._written = _by_name(state_in), _by_name(state_out)
        self._target = getattr(control, "grip_target", None)
        wanted = [*self._read.values(), *([self._target] if self._target is not None else [])]
        self._wanted = [array for array in wanted if array.requires_grad]

    @property
    def needed(self) -> bool:
        """Whether anything that the step reads asks for gradients."""
        return bool(self._wanted)

    def check(self, tape: Any) -> None:
        """Refuse what would lose derivatives without a word.

        Raises:
            InputError: the end of the step asks for no gradients, or the tape knows the states.
        """
        if not self.needed:
            return
        deaf = [name for name, array in self._written.items() if not array.requires_grad]
        if deaf:
            raise InputError(
                f"state_out.{deaf[0]} needs requires_grad under a wp.Tape, as what the step reads "
                "has it: take states from model.state(requires_grad=True)"
            )
        earlier = [taken for taken in tape.launches if isinstance(taken, TapedStep)]
        known = {id(a) for t in (self, *earlier) for a in t._read.values()}
        known |= {id(a) for t in earlier for a in t._written.values()}
        if any(id(array) in known for array in self._written.values()):
            raise InputError(
                "state_out is part of the wp.Tape already: under a tape every step needs a state "
                "of its own to write, as derivatives are taken at the states between"
            )

    def run(self, steps: int, dt: float) -> list[WatchValues]:
        """Take `steps` substeps of `dt` [s] from the state that the solver has read.

        Returns the guards' values by world.
        """
        data, solver = self._solver.data, self._solver
        paths = self._paths(steps * dt)
        values: dict[int, WatchValues] = {}
        topologies = np.asarray(data.world_topology)
        for kind in np.unique(topologies):
            worlds = [int(w) for w in np.flatnonzero(topologies == kind)]
            held = {w: path for w, path in paths.items() if w in worlds}
            every = solver.damp_every(steps, dt=dt)
            rollout = DifferentiableRollout(solver, storage="full", dt=dt, damp_every=every)
            rollout.forward(worlds, [steps * dt], paths=held)
            values |= {w: rollout.watch[w] for w in worlds}
            self._runs.append((worlds, rollout, held))
        return [values[w] for w in range(data.world_count)]

    def record(self, tape: Any) -> None:
        """Leave the step on the tape."""
        tape.record_func(self, [*self._wanted, *self._written.values()])

    def __call__(self) -> None:
        """Add the derivatives by what the step read, from those by what it wrote."""
        with unrecorded():
            after = {name: array.grad.numpy() for name, array in self._written.items()}
            if any(gradient.any() for gradient in after.values()):
                for worlds, rollout, held in self._runs:
                    self._sweep(worlds, rollout, held, after)

    def _sweep(
        self,
        worlds: list[int],
        rollout: DifferentiableRollout,
        held: dict[int, GripPath],
        after: dict[str, np.ndarray],
    ) -> None:
        data = self._solver.data
        rows = {
            "particle": [data.particle_ids[w] for w in worlds],
            "body": [data.body_ids[w] for w in worlds] if data.has_bodies else [],
        }
        gradients = {
            name: np.stack([after[name][ids] for ids in rows[name.split("_")[0]]])[:, None]
            for name in after
        }
        by = rollout.backward(
            gradients.get("particle_q"),
            gradients.get("particle_qd"),
            bodies=gradients.get("body_q"),
            body_velocities=gradients.get("body_qd"),
        )
        before = {
            "particle_q": by.positions.copy(),
            "particle_qd": by.velocities,
            "body_q": by.body_poses,
            "body_qd": by.body_velocities,
        }
        targets = np.zeros((data.world_count, 3))
        for w, path in held.items():
            start, end = by.waypoints[w]
            # the second knot lies as far beyond the target as the first lies before it
            before["particle_q"][worlds.index(w), path.particle] += start - end
            targets[w] = 2 * end
        for name, array in self._read.items():
            if array.requires_grad:
                total = np.zeros(array.grad.numpy().shape)
                for ids, gradient in zip(rows[name.split("_")[0]], before[name], strict=True):
                    total[ids] = gradient
                _add(array, total)
        if self._target is not None and self._target.requires_grad:
            _add(self._target, targets)

    def _paths(self, duration: float) -> dict[int, GripPath]:
        """The grips that the solver has read from the control, as paths of two knots."""
        data, paths = self._solver.data, {}
        for w in range(data.world_count):
            slot = data.slot[w]
            particle = int(data.views["grips.particle"][slot])
            if particle >= 0:
                first = int(data.views["grips.knot"][slot])
                knots = data.views["grips.position"][first : first + 2].copy()
                paths[w] = GripPath(np.array([0.0, 2 * duration]), knots, particle=particle)
        return paths


def _by_name(state: newton.State, *, gradients: bool = False) -> dict[str, wp.array]:
    """The arrays of a state that hold something; gradients: those that ask for gradients."""
    arrays = {name: getattr(state, name) for name in STATE}
    return {
        name: array
        for name, array in arrays.items()
        if array is not None and len(array) and (array.requires_grad or not gradients)
    }


def _add(array: wp.array, gradient: np.ndarray) -> None:
    """Add to the gradient of an array."""
    array.grad.assign(array.grad.numpy() + gradient.astype(np.float32))
