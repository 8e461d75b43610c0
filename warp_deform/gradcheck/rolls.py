"""Rollouts from values of all parameters, and the loss that is taken of where they end."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..rollout.differentiable import DifferentiableRollout, Gradients
from ..worlds.worlds import Worlds
from ..xpbd.config import WORLD_PARAMETERS
from ..xpbd.packing.parts import PARTS, set_parts
from .branches import counted, taken
from .draws import Draw, touching_of

__all__ = ["ARM", "Loss", "put_back", "roll"]

ARM = 0.05
"""A turn moves a point so far from the centre by as much as a unit of position does [m]."""
_OF_PATH = ("waypoints", "knot_times", "knot_rotations")


@dataclass(frozen=True, eq=False)
class Loss:
    """A random linear loss of positions [m] and steps (velocities times dt) at the end."""

    positions: np.ndarray
    velocities: np.ndarray
    bodies: np.ndarray
    body_velocities: np.ndarray

    @staticmethod
    def draw(worlds: Worlds, rng: np.random.Generator) -> Loss:
        data, dt = worlds.solver.data, worlds.solver.config.dt
        particles = data.lane("particles.x", 0).shape
        rows = data.body_rows(0)
        bodies = rows.stop - rows.start
        turn = np.array([1.0, 1.0, 1.0, *[2 * ARM] * 4])
        return Loss(
            positions=rng.normal(size=particles),
            velocities=rng.normal(size=particles) * dt,
            bodies=rng.normal(size=(bodies, 7)) * turn,
            body_velocities=rng.normal(size=(bodies, 6)) * dt * np.array([1.0] * 3 + [ARM] * 3),
        )

    def size(self) -> float:
        """Length of its derivative by positions."""
        return float(np.sqrt((self.positions**2).sum() + (self.bodies**2).sum()))

    def change(self, ends: dict[str, np.ndarray], i: int, j: int) -> float:
        """Between worlds: the difference of the ends first, as less is lost to rounding."""
        return sum(float((vars(self)[n] * (ends[n][i] - ends[n][j])).sum()) for n in ends)

    def backward(self, run: DifferentiableRollout, count: int, *, parts: bool) -> Gradients:
        each = np.ones((count, 1, 1, 1))
        return run.backward(**{name: each * by for name, by in vars(self).items()}, parts=parts)


def roll(
    run: DifferentiableRollout,
    worlds: Worlds,
    draw: Draw,
    substeps: int,
    moved: dict[str, list[np.ndarray]],
    loss: Loss,
) -> tuple[dict[str, np.ndarray], list[np.ndarray], np.ndarray, Gradients]:
    """What the loss is of, the branches and how often constraints acted, from values of all
    parameters in each world; and the derivatives of the first ones.

    Worlds share their parts, so those in which they are other than in the first one run by
    themselves, one after another.
    """
    own = [
        k
        for k in range(len(moved["damping"]))
        if any(moved[name][k] is not moved[name][0] for name in PARTS)
    ]
    others = [k for k in range(len(moved["damping"])) if k not in own]
    ends: dict[str, np.ndarray] = {}
    words: list[np.ndarray] = [np.zeros(0)] * len(moved["damping"])
    first: Gradients | None = None
    counts = np.zeros(0)
    for some in (others, *([k] for k in own)):
        part = {name: [values[k] for k in some] for name, values in moved.items()}
        found = _together(run, worlds, draw, substeps, part)
        # of all others only how often constraints acted is asked for
        gradients = loss.backward(run, len(some), parts=first is None)
        first = first or gradients
        acted = counted(gradients.fired)
        if not ends:
            ends = {n: np.zeros((len(words), *v.shape[1:])) for n, v in found.items()}
            counts = np.zeros((len(words), *acted.shape[1:]))
        for name, value in found.items():
            ends[name][some] = value
        counts[some] = acted
        for k, word in zip(some, taken(run)[: len(some)], strict=True):
            words[k] = word
    assert first is not None
    return ends, words, counts, first


def _together(
    run: DifferentiableRollout,
    worlds: Worlds,
    draw: Draw,
    substeps: int,
    moved: dict[str, list[np.ndarray]],
) -> dict[str, np.ndarray]:
    """What the loss is of, in each world, from values of all parameters in each; parts as the first
    one has them.
    """
    data, dt, path = worlds.solver.data, worlds.solver.config.dt, draw.path
    count = len(moved["damping"])
    paths = {}
    if path is not None:
        for w in range(count):
            paths[w] = replace(
                path,
                positions=moved["waypoints"][w],
                times=moved["knot_times"][w],
                rotations=moved["knot_rotations"][w] if "knot_rotations" in moved else None,
            )
    for w in range(count):
        _set_body_masses(worlds, w, moved["body_inverse_masses"][w])
        touching_of(worlds, w)[:] = draw.touching
    stacked = {
        name: np.stack(values) for name, values in moved.items() if name not in (*_OF_PATH, *PARTS)
    }
    ends = run.forward(
        range(count),
        [substeps * dt],
        paths=paths,
        positions=stacked["positions"],
        velocities=stacked["velocities"],
        body_poses=stacked["body_poses"],
        body_velocities=stacked["body_velocities"],
        parameters={n: stacked[n] for n in (*WORLD_PARAMETERS, "inverse_masses")}
        | {n: moved[n][0] for n in PARTS},
    )
    return {
        "positions": ends[:, 0],
        "velocities": np.stack([data.lane("particles.v", w) for w in range(count)]),
        "bodies": run.body_poses[:, 0],
        "body_velocities": np.stack([data.body_poses(w)[1] for w in range(count)]),
    }


def put_back(worlds: Worlds, base: dict[str, np.ndarray], count: int) -> None:
    """What `Worlds.restore` takes for granted, in the first `count` worlds."""
    for name in PARTS:
        set_parts(worlds.solver.data, 0, name, base[name])
    for w in range(count):
        worlds.solver.set_world(w, **{n: float(base[n]) for n in WORLD_PARAMETERS})
        for name in ("w0", "w"):
            worlds.solver.data.lane(f"particles.{name}", w)[:] = base["inverse_masses"]
        _set_body_masses(worlds, w, base["body_inverse_masses"])


def _set_body_masses(worlds: Worlds, world: int, inverse: np.ndarray) -> None:
    data = worlds.solver.data
    for name in ("w0", "w"):
        data.arrays[f"bodies.{name}"].view[data.body_rows(world)] = inverse
