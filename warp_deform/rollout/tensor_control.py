"""Control steps as functions of torch tensors: derivatives flow through a whole episode."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch.autograd.function import once_differentiable

from ..errors import InputError
from ..xpbd.continuing.lasting_grips import KNOTS
from ..xpbd.fused_xpbd import FusedXPBD
from ..xpbd.guards import Problem
from ..xpbd.recording.recorded_launch import RecordedLaunch
from .control import ControlLoop, control_substeps
from .tensor_state import TensorState, put, rotated
from .world_rows import WorldRows

__all__: list[str] = []  # `warp_deform.rollout` is the import path of what is here


class TensorControlLoop:
    """A `ControlLoop` with derivatives: one recording serves an episode of any length.

        loop = TensorControlLoop(solver)
        state = loop.begin([0, 1])
        loop.hold(0, particle=23)
        for _ in range(20):
            state = loop.advance(loop.tips + policy(state))
        loss(state.positions).backward()
        loop.end()

    It runs the bits of a `ControlLoop`. Derivatives are those of `DifferentiableRollout` along the
    whole path, with its branches, by the start and by every target. Each control step is swept
    back by itself: where autograd asks for it, in the order in which it asks, with what derivatives
    it has by the state after the step.

    What is recorded lives until `detach`, or until another episode begins; derivatives through what
    was freed are refused. Nothing is recorded without a tensor that requires grad, or under
    `torch.no_grad`. A second derivative is refused.

    A tip is where `hold` says, or else where the particle is that it holds, or at the centre of
    mass of a body, turned as it.
    Worlds of one topology take part together, in the order in which they were named first. One that
    has ended, while others go on, may begin again as it is then.

    Args:
        rate: see `ControlLoop`
        storage: see `RecordedLaunch`
        memory: most bytes of all tapes and checkpoints; a step for which there are none is refused
        sleep: False leaves the sleep of fabrics out, which holds what a derivative should move
    """

    def __init__(
        self,
        solver: FusedXPBD,
        *,
        rate: float = 20.0,
        storage: str = "auto",
        memory: int = 2**30,
        sleep: bool = True,
    ) -> None:
        self.solver = solver
        substeps = control_substeps(rate, solver.config.dt)
        self._launch = RecordedLaunch(solver, substeps, storage=storage, memory=memory, sleep=sleep)
        self._plain = ControlLoop(solver, rate=rate, launch=self._launch)
        self.worlds: list[int] = []
        """Numbers of the worlds, row by row (W)."""
        self.problems: dict[int, tuple[Problem, ...]] = {}
        """Guards that have fired in worlds since they began, see `ControlLoop.advance`."""
        self.state: TensorState
        """At the end of the last control step."""
        self._tips: torch.Tensor
        self._turns: torch.Tensor
        self._taken: list[tuple[int, int | None, int | None]] = []

    @property
    def nbytes(self) -> int:
        """Most bytes of tapes and checkpoints so far since `detach`, or since an episode began."""
        return self._launch.nbytes

    def begin(
        self,
        worlds: Sequence[int],
        *,
        positions: torch.Tensor | None = None,
        velocities: torch.Tensor | None = None,
        body_poses: torch.Tensor | None = None,
        body_velocities: torch.Tensor | None = None,
    ) -> TensorState:
        """Take worlds under control, from the tensors that are given, or else as they are.

        Args:
            positions: of the particles (W, P, 3) [m]
            velocities: of the particles (W, P, 3) [m/s]
            body_poses: of the bodies' frames (W, B, 7), position [m] and quat_xyzw of unit length
            body_velocities: twists (W, B, 6), linear [m/s], angular [rad/s]

        Raises:
            InputError: worlds of several topologies, tensors of other shapes than theirs, a world
                that has begun, or another one than of those that the episode began with.
        """
        data, names = self.solver.data, [int(w) for w in worlds]
        anew = not len(self._plain.worlds)
        if not names or any(not 0 <= w < data.world_count for w in names):
            raise InputError(f"no worlds {names}: the solver has {data.world_count}")
        if len({int(data.world_topology[w]) for w in names}) != 1:
            raise InputError("derivatives are taken of worlds of one topology at a time")
        if not anew and not set(names) <= set(self.worlds):
            raise InputError(f"worlds {names} were not all there when the episode began")
        given = {
            "positions": positions,
            "velocities": velocities,
            "body_poses": body_poses,
            "body_velocities": body_velocities,
        }
        rows = WorldRows(data, names)
        here = self._read(rows)
        for name, tensor in given.items():
            shape = tuple(getattr(here, name).shape)
            if tensor is not None and (
                tuple(tensor.shape) != shape or not torch.isfinite(tensor).all()
            ):
                raise InputError(f"{name} must be finite and have the shape {shape}")
        self._write(names, given)
        self._plain.begin(names)
        start = self._read(rows)
        known = {n: t.to(getattr(start, n)) for n, t in given.items() if t is not None}
        start = replace(start, **known)
        if anew:
            self._launch.free()
            self.worlds, self._rows, self.state = names, rows, start
            self._tips = start.positions.new_zeros(len(names), 3)
            self._turns = start.positions.new_zeros(len(names), 4)
            self._turns[:, 3] = 1.0
            self._taken, self.problems = [], {}
        else:
            at = torch.tensor([self.worlds.index(w) for w in names])
            put = [
                old.index_copy(0, at, new)
                for old, new in zip(self.state.tensors(), start.tensors(), strict=True)
            ]
            self.state = TensorState(*put)
        return self.state

    def _write(self, worlds: list[int], given: dict[str, torch.Tensor | None]) -> None:
        data = self.solver.data
        values = {n: None if t is None else _numpy(t) for n, t in given.items()}
        for k, w in enumerate(worlds):
            for name, array in (("x", values["positions"]), ("v", values["velocities"])):
                if array is not None:
                    data.lane(f"particles.{name}", w)[:] = array[k]
                    data.wake(w)
            if values["body_poses"] is not None or values["body_velocities"] is not None:
                poses, twists = data.body_poses(w)
                if values["body_poses"] is not None:
                    poses = values["body_poses"][k]
                if values["body_velocities"] is not None:
                    twists = values["body_velocities"][k]
                data.set_bodies(w, poses, twists)

    def _read(self, rows: WorldRows) -> TensorState:
        views = self.solver.data.views
        state = (
            rows.of_particles(views["particles.x"]), rows.of_particles(views["particles.v"]),
            rows.poses(views), rows.twists(views),
        )  # fmt: skip
        number = self.solver.data.number
        return TensorState(*(torch.from_numpy(np.array(s, dtype=number)) for s in state))

    def hold(
        self,
        world: int,
        *,
        particle: int | None = None,
        body: int | None = None,
        tip: np.ndarray | None = None,
        rotation: np.ndarray | None = None,
    ) -> None:
        """Hold a particle or a body from now on, where it is.

        Args:
            tip: see `ControlLoop.hold`, as `rotation`; it is no function of what is held

        Raises:
            InputError: the world has not begun, holds something, or has nothing of the kind.
        """
        if body is not None and tip is None:
            self._launch.check_holdable(world, particle, body)
            row = self.solver.data.body_rows(world).start + body
            rotation = self.solver.data.views["bodies.q"][row].astype(float)
        self._plain.hold(world, particle=particle, body=body, tip=tip, rotation=rotation)
        k = self.worlds.index(world)
        if tip is None:
            self._taken.append((k, particle, body))
            return
        self._tips = put(self.tips, (k,), torch.as_tensor(tip))
        if rotation is not None:
            self._turns = put(self.turns, (k,), torch.as_tensor(rotation))

    def _place_tips(self) -> None:
        """Put tips to what has been taken hold of since the last step, for all worlds at once."""
        particles = [(k, i) for k, i, _ in self._taken if i is not None]
        bodies = [(k, b) for k, _, b in self._taken if b is not None]
        self._taken = []
        if particles:
            k, i = torch.tensor(particles).T
            upright = self._turns.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(len(k), 4)
            self._tips = self._tips.index_put((k,), self.state.positions[k, i].to(self._tips))
            self._turns = self._turns.index_put((k,), upright)
        if bodies:
            k, b = torch.tensor(bodies).T
            pose = self.state.body_poses[k, b]
            top = self.solver.data.topologies[self.solver.data.world_topology[self.worlds[0]]]
            at = pose[:, :3] + rotated(pose[:, 3:], pose.new_tensor(np.asarray(top.body_com))[b])
            self._tips = self._tips.index_put((k,), at.to(self._tips))
            self._turns = self._turns.index_put((k,), pose[:, 3:].to(self._turns))

    @property
    def tips(self) -> torch.Tensor:
        """Where tips are that hold something (W, 3) [m]; where they held last, in other rows."""
        self._place_tips()
        return self._tips

    @property
    def turns(self) -> torch.Tensor:
        """Rotations of the tips (W, 4) quat_xyzw."""
        self._place_tips()
        return self._turns

    def let_go(self, world: int, *, release: str = "rest", calm: float = 0.0) -> None:
        """Let go of what a world holds, if anything, see `ControlLoop.let_go`."""
        self._place_tips()
        particle, body = self._launch.held(world)
        self._plain.let_go(world, release=release, calm=calm)
        k = self.worlds.index(world)
        if release == "rest" and particle >= 0:
            speeds = self.state.velocities
            still = speeds.new_zeros(3)
            self.state = replace(self.state, velocities=put(speeds, (k, particle), still))
        if release == "rest" and body >= 0:
            speeds = self.state.body_velocities
            still = speeds.new_zeros(6)
            self.state = replace(self.state, body_velocities=put(speeds, (k, body), still))

    def holding(self) -> np.ndarray:
        """Which of the worlds hold something (W,)."""
        return self._launch.holding(self.worlds)

    def advance(
        self, targets: torch.Tensor | None = None, rotations: torch.Tensor | None = None
    ) -> TensorState:
        """Run one control step, see `ControlLoop.advance`; the state at its end.

        Args:
            targets: of the tips (W, 3) or (W, K, 3) [m]; None: they wait
            rotations: of the tips (W, 4) or (W, K, 4) quat_xyzw; None: they do not turn

        Raises:
            InputError: as `ControlLoop.advance`, and where there is no memory to record the step;
                nothing has moved then.
        """
        if not self.worlds:
            raise InputError("no world is under control: call begin() first")
        places = self.tips if targets is None else targets
        turns = self.turns if rotations is None else rotations
        if rotations is not None:
            turns = rotations / rotations.norm(dim=-1, keepdim=True)
        ways = self._knots(places, turns, targets is None, rotations is None)
        inputs = (*self.state.tensors(), self.tips, self.turns, *ways)
        self._launch.recording = torch.is_grad_enabled() and any(t.requires_grad for t in inputs)
        self.state = TensorState(*_ControlStep.apply(self, *inputs))
        self._tips, self._turns = ways[0][:, -1], ways[1][:, -1]
        return self.state

    def _knots(
        self, places: torch.Tensor, turns: torch.Tensor, waits: bool, stays: bool
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Positions (W, K, 3) and rotations (W, K, 4) of the knots."""
        count = len(self.worlds)
        for name, tensor, width in (("targets", places, 3), ("rotations", turns, 4)):
            if tensor.ndim not in (2, 3) or (len(tensor), tensor.shape[-1]) != (count, width):
                raise InputError(
                    f"{name} of {count} worlds must have the shape ({count}, {width}) or "
                    f"({count}, K, {width}), not {tuple(tensor.shape)}"
                )
        places = places if places.ndim == 3 else places[:, None]
        turns = turns if turns.ndim == 3 else turns[:, None]
        if waits:
            places = places.expand(-1, turns.shape[1], -1)
        if stays:
            turns = turns.expand(-1, places.shape[1], -1)
        return places, turns

    def detach(self) -> TensorState:
        """Cut the graph here, and free what is recorded: what follows knows nothing of before."""
        self.state = TensorState(*(tensor.detach() for tensor in self.state.tensors()))
        self._tips, self._turns = self.tips.detach(), self.turns.detach()
        self._launch.free()
        return self.state

    def end(self, worlds: Sequence[int] | None = None) -> None:
        """Leave worlds (None: all) as they are; what one holds is let go at rest.

        Derivatives through their steps may still be taken, until another episode begins.

        Raises:
            InputError: one has not begun.
        """
        self._plain.end(worlds)

    # -- for `_ControlStep`

    def _run(self, places: np.ndarray, turns: np.ndarray) -> tuple[int, TensorState]:
        """Run a step; the number of its recording, and the state after it."""
        names = self.worlds
        live = self._launch.open[names]
        if not live.all():
            names = [w for w, goes_on in zip(names, live, strict=True) if goes_on]
            places, turns = places[live], turns[live]
        self.problems = self._plain.advance(places, turns, worlds=names)
        return self._launch.last, self._read(self._rows)

    def _sweep(
        self, number: int, count: int, before: np.ndarray, after: np.ndarray, turns: np.ndarray,
        cotangents: Sequence[np.ndarray | None],
    ) -> tuple[np.ndarray, ...]:  # fmt: skip
        """Derivatives by the inputs of a step.

        Args:
            number: of its recording
            count: its knots
            before: rotations of the bodies before it (W, B, 4)
            after: the same after it, by row of bodies
            turns: rotations as they were given (W, 1 + K, 4)
        """
        rows = self._rows
        x, v, poses, twists = cotangents
        given = {
            name: rows.to_particles(name, g)
            for name, g in (("particles.x", x), ("particles.v", v))
            if g is not None
        }
        given |= rows.body_cotangents({"bodies.q": after}, poses, twists)
        out = self._launch.sweep(number, given)
        slots = self.solver.data.slot[self.worlds]
        knots = slots[:, None] * KNOTS + np.arange(1 + count)
        by_turns, used = out["rotation"][knots], self._launch.rotations(number)[knots]
        by_turns *= np.where((used * turns).sum(axis=-1, keepdims=True) < 0, -1.0, 1.0)
        by_places = out["position"][knots]
        return (
            rows.of_particles(out["x"]),
            rows.of_particles(out["v"]),
            rows.by_frames(before, out["body.x"], out["body.q"]),
            np.concatenate(
                [rows.of_bodies(out["body.v"]), rows.of_bodies(out["body.omega"])], axis=-1
            ),
            by_places[:, 0],
            by_turns[:, 0],
            by_places[:, 1:],
            by_turns[:, 1:],
        )


class _ControlStep(torch.autograd.Function):
    """One control step: the state before it, tips and knots in, the state after it out."""

    @staticmethod
    def forward(
        ctx: Any, loop: TensorControlLoop, *inputs: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        *_, turn, places, turns = (_numpy(tensor) for tensor in inputs)
        bodies = loop.solver.data.views["bodies.q"]
        before = loop._rows.of_bodies(bodies)
        number, state = loop._run(places, turns)
        ctx.loop, ctx.likes = loop, [(t.dtype, t.device) for t in inputs]
        ctx.recorded = number, places.shape[1], before, bodies.copy(), turn, turns
        ctx.set_materialize_grads(False)
        return state.tensors()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *cotangents: torch.Tensor | None) -> tuple[torch.Tensor | None, ...]:
        number, count, before, after, turn, turns = ctx.recorded
        given = [None if c is None else _numpy(c) for c in cotangents]
        out = ctx.loop._sweep(
            number, count, before, after, np.concatenate([turn[:, None], turns], axis=1), given
        )
        return None, *(
            torch.as_tensor(g).to(dtype=like[0], device=like[1]) if need else None
            for g, like, need in zip(out, ctx.likes, ctx.needs_input_grad[1:], strict=True)
        )


def _numpy(tensor: torch.Tensor) -> np.ndarray:
    array: np.ndarray = tensor.detach().cpu().numpy()
    return array
