"""Rollouts as functions of torch tensors: derivatives flow through them, from call to call."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch.autograd.function import once_differentiable

from ..errors import InputError
from ..objects.push import Push
from ..xpbd.config import WORLD_PARAMETERS
from ..xpbd.fused_xpbd import FusedXPBD
from ..xpbd.guards import WatchValues
from ..xpbd.packing.parts import PARTS
from .differentiable import DifferentiableRollout, Gradients
from .rollouts import GripPath

__all__: list[str] = []  # `warp_deform.rollout` is the import path of what is here

_STATE = ("positions", "velocities", "body_poses", "body_velocities")
_PARAMETERS = (*WORLD_PARAMETERS, "inverse_masses", *PARTS)
_KNOTS = {"waypoints": "positions", "knot_times": "times", "knot_rotations": "rotations"}
"""Tensors by the fields of `GripPath` that they stand for."""


@dataclass(frozen=True, eq=False)
class TensorRollout:
    """Worlds (W) at times (T), as tensors of the solver's precision.

    Attributes:
        positions: of the particles (W, T, P, 3) [m]
        velocities: of the particles (W, T, P, 3) [m/s]
        body_poses: of the bodies' frames (W, T, B, 7), position [m] and quat_xyzw
        body_velocities: twists (W, T, B, 6), linear at the centre of mass [m/s], angular [rad/s]
        watch: the guards' values by world of the solver
    """

    positions: torch.Tensor
    velocities: torch.Tensor
    body_poses: torch.Tensor
    body_velocities: torch.Tensor
    watch: list[WatchValues]

    @property
    def end(self) -> dict[str, torch.Tensor]:
        """The state at the last time, as `rollout_tensors` takes it for a start."""
        return {name: getattr(self, name)[:, -1] for name in _STATE}


def rollout_tensors(
    solver: FusedXPBD,
    worlds: Sequence[int],
    times: Sequence[float],
    *,
    positions: torch.Tensor | None = None,
    velocities: torch.Tensor | None = None,
    body_poses: torch.Tensor | None = None,
    body_velocities: torch.Tensor | None = None,
    inverse_masses: torch.Tensor | None = None,
    spring_stiffness: torch.Tensor | None = None,
    rest_lengths: torch.Tensor | None = None,
    radii: torch.Tensor | None = None,
    damping: torch.Tensor | None = None,
    table_friction: torch.Tensor | None = None,
    contact_friction: torch.Tensor | None = None,
    stiffness: torch.Tensor | None = None,
    paths: Mapping[int, GripPath] | None = None,
    waypoints: Mapping[int, torch.Tensor] | None = None,
    knot_times: Mapping[int, torch.Tensor] | None = None,
    knot_rotations: Mapping[int, torch.Tensor] | None = None,
    pushes: Mapping[int, Sequence[Push]] | None = None,
    storage: str = "auto",
    memory: int = 2**30,
    sleep: bool = True,
    until_rest: bool = False,
    calm: float | Mapping[int, float] = 0.0,
    calm_after: float = 0.0,
) -> TensorRollout:
    """Run `worlds` and give their states at `times` [s] from the start, ascending.

        first = rollout_tensors(solver, [0], [1.0], positions=x, paths=paths, waypoints={0: knots})
        second = rollout_tensors(solver, [0], [1.0], **first.end)
        loss(second.positions[:, -1]).backward()  # fills x.grad and knots.grad

    Derivatives are those of `DifferentiableRollout`, by every tensor that is given; their branches
    and their growth are explained there. A second derivative is refused.

    The solver may be used for anything between this call and `backward`, which leaves it as it is.

    The start is that of `positions`, `velocities`, `body_poses` and `body_velocities`; of those
    that are None it is as the worlds are. Quaternions are of unit length, and derivatives lie along
    their sphere. The tape lives as long as the graph that needs it, so a chain of n calls holds n
    of them, each of `memory` bytes at most.

    Args:
        positions: of the particles at the start (W, P, 3) [m]
        velocities: of the particles at the start (W, P, 3) [m/s]
        body_poses: of the bodies' frames at the start (W, B, 7), position [m] and quat_xyzw
        body_velocities: twists at the start (W, B, 6), linear [m/s], angular [rad/s]
        damping: (W,) [1/s]; this and the next seven stay set
        table_friction: (W,)
        contact_friction: (W,)
        stiffness: (W,)
        inverse_masses: (W, P) [1/kg]
        spring_stiffness: of each spring (S,) [N/m], in the order of the model's. This and the next
            two are those of all worlds of the topology, see `set_parts`
        rest_lengths: of each spring (S,) [m]; strain limits and floors are shares of it
        radii: of the particles (P,) [m]
        paths: by world
        waypoints: by world (K, 3) [m], in place of the positions of its path
        knot_times: by world (K,) [s], in place of its times
        knot_rotations: by world (K, 4) quat_xyzw, in place of its rotations
        storage: see `Recorder`
        memory: see `Recorder`
        sleep: see `Recorder`
        pushes: see `DifferentiableRollout.forward`
        until_rest: see `DifferentiableRollout.forward`
        calm: see `DifferentiableRollout.forward`
        calm_after: see `DifferentiableRollout.forward`

    Raises:
        InputError: tensors of other shapes than the worlds', knots of a world without a path, and
            what `DifferentiableRollout.forward` refuses.
    """
    names = list(map(int, worlds))
    own = [w for w in names if not 0 <= w < solver.data.world_count]
    if own or not names:
        raise InputError(f"no worlds {own or names}: the solver has {solver.data.world_count}")
    top = solver.data.topologies[solver.data.world_topology[names[0]]]
    count, particles, bodies = len(names), top.particle_count, top.body_count
    given: dict[Any, tuple[torch.Tensor | None, tuple[int, ...]]] = {
        "positions": (positions, (count, particles, 3)),
        "velocities": (velocities, (count, particles, 3)),
        "body_poses": (body_poses, (count, bodies, 7)),
        "body_velocities": (body_velocities, (count, bodies, 6)),
        "inverse_masses": (inverse_masses, (count, particles)),
        "spring_stiffness": (spring_stiffness, (len(top.spring_ij),)),
        "rest_lengths": (rest_lengths, (len(top.spring_ij),)),
        "radii": (radii, (particles,)),
        "damping": (damping, (count,)),
        "table_friction": (table_friction, (count,)),
        "contact_friction": (contact_friction, (count,)),
        "stiffness": (stiffness, (count,)),
    }
    paths = dict(paths or {})
    for name, tensors, width in (
        ("waypoints", waypoints, (3,)), ("knot_times", knot_times, ()),
        ("knot_rotations", knot_rotations, (4,)),
    ):  # fmt: skip
        for w, tensor in (tensors or {}).items():
            if w not in paths or w not in names:
                raise InputError(f"{name} of world {w}, which has no path: give it in paths")
            given[name, w] = tensor, (len(paths[w].times), *width)
    keys = [key for key, (tensor, _) in given.items() if tensor is not None]
    tensors_in = [_checked(key, *given[key]) for key in keys]
    run = DifferentiableRollout(solver, storage=storage, memory=memory, sleep=sleep)

    def forward(values: dict[Any, np.ndarray]) -> np.ndarray:
        changed = dict(paths)
        for key, value in values.items():
            if isinstance(key, tuple):
                name, w = key
                field: dict[str, Any] = {_KNOTS[name]: value}
                changed[w] = replace(changed[w], **field)
        return run.forward(
            names,
            times,
            paths=changed,
            pushes=pushes,
            until_rest=until_rest,
            calm=calm,
            calm_after=calm_after,
            parameters={n: values[n] for n in _PARAMETERS if n in values},
            **{n: values[n] for n in _STATE if n in values},
        )

    states: tuple[torch.Tensor, ...] = _Rollout.apply(run, forward, keys, *tensors_in)
    return TensorRollout(**dict(zip(_STATE, states, strict=True)), watch=run.watch)


def _checked(key: Any, tensor: torch.Tensor | None, shape: tuple[int, ...]) -> torch.Tensor:
    name = key if isinstance(key, str) else f"{key[0]} of world {key[1]}"
    if not isinstance(tensor, torch.Tensor) or not tensor.is_floating_point():
        raise InputError(f"{name} must be a tensor of floating-point numbers, not {tensor!r:.60}")
    if tuple(tensor.shape) != shape:
        raise InputError(f"{name} must have the shape {shape}, not {tuple(tensor.shape)}")
    if not torch.isfinite(tensor).all():
        raise InputError(f"{name} holds numbers that are not finite")
    return tensor


class _Rollout(torch.autograd.Function):
    """One rollout with its own tape: tensors by key in, states at the marks out."""

    @staticmethod
    def forward(
        ctx: Any,
        run: DifferentiableRollout,
        forward: Callable[[dict[Any, np.ndarray]], np.ndarray],
        keys: list[Any],
        *tensors: torch.Tensor,
    ) -> tuple[torch.Tensor, ...]:
        # copies: what the caller writes into a tensor later must not reach the paths
        values = {
            key: np.array(tensor.detach().cpu().numpy(), dtype=float)
            for key, tensor in zip(keys, tensors, strict=True)
        }
        states = forward(values), run.velocities, run.body_poses, run.body_velocities
        ctx.run, ctx.keys = run, keys
        ctx.likes = [(tensor.dtype, tensor.device) for tensor in tensors]
        ctx.set_materialize_grads(False)
        device = tensors[0].device if tensors else torch.device("cpu")
        number = run.solver.data.number
        return tuple(torch.from_numpy(np.array(state, dtype=number)).to(device) for state in states)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *cotangents: torch.Tensor | None) -> tuple[Any, ...]:
        positions, velocities, bodies, body_velocities = (
            None if given is None else given.detach().cpu().numpy() for given in cotangents
        )
        wanted = ctx.needs_input_grad[3:]
        needed = {key for key, need in zip(ctx.keys, wanted, strict=True) if need}
        gradients = ctx.run.backward(
            positions,
            velocities,
            bodies=bodies,
            body_velocities=body_velocities,
            parts=not needed.isdisjoint(("inverse_masses", *PARTS)),
        )
        out = [
            torch.as_tensor(_by(gradients, key)).to(dtype=like[0], device=like[1]) if need else None
            for key, like, need in zip(ctx.keys, ctx.likes, wanted, strict=True)
        ]
        return (None, None, None, *out)


def _by(gradients: Gradients, key: Any) -> np.ndarray:
    """The derivative by what was given under a key: a name, or a name and a world."""
    if isinstance(key, tuple):
        by_world: dict[int, np.ndarray] = getattr(gradients, key[0])
        return by_world[key[1]]
    value: np.ndarray = getattr(gradients, key)
    return value.sum(axis=0) if key in PARTS else value
