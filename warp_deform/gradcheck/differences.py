"""Directional derivatives of short rollouts beside central differences, by the same worlds.

World 0 of a launch runs as drawn; two others run for every direction, moved by plus and minus a
step. The adjoint of world 0 times the direction is compared with the limit of their difference over
a ladder of steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..rollout.differentiable import DifferentiableRollout, Gradients
from ..rollout.rollouts import GripPath
from ..support.quaternion import quat_by_rotation
from ..worlds.worlds import Worlds
from ..xpbd.config import WORLD_PARAMETERS
from ..xpbd.packing.parts import PARTS, parts
from .draws import Draw, touching_of
from .limits import RATIO, central, kink
from .rolls import ARM, Loss, put_back, roll

__all__ = ["PARAMETERS", "RUNGS", "STEPS", "WORLDS", "Sample", "compare", "fired"]

STEPS = {
    "positions": 1e-7,
    "velocities": 2.5e-4,
    "inverse_masses": 3e-2,
    "body_poses": 1e-7,
    "body_velocities": 2.5e-4,
    "body_inverse_masses": 3e-2,
    "waypoints": 1e-7,
    "knot_times": 1e-6,
    "knot_rotations": 1e-6,
    "damping": 10.0,
    "table_friction": 3e-2,
    "contact_friction": 3e-2,
    "stiffness": 0.3,
    "spring_stiffness": 0.1,
    "rest_lengths": 1e-7,
    "radii": 1e-7,
}
"""Largest steps of the differences over a substep, in SI units (inverse masses and stiffness of
springs: as a share of each; turns: as motion at `ARM`): far above rounding. Contacts are a
micrometre deep, so the ladder leads down to where few directions cross a branch."""
PARAMETERS = tuple(STEPS)
RUNGS = 5
SMOOTH_RUNGS, DEEPEST = 3, 9
"""Where fewer than so many of the lowest rungs cross no branch, a ladder goes on downwards while
rounding is below the bound, to so many rungs at most."""
AIR = 1.0
"""What has no air is checked in this much [1/s]."""
EPSILON = 2.2e-16
"""Relative rounding of float64; positions are below 1 m."""
KINK = 1e-6
"""One-sided derivatives that differ by more than this share: a branch begins there."""
CHUNK = 14
"""Directions of one launch."""
WORLDS = 1 + 2 * CHUNK
"""Worlds that `compare` uses."""
_GROWING = (
    "velocities",
    "inverse_masses",
    "body_velocities",
    "body_inverse_masses",
    *WORLD_PARAMETERS,
    *PARTS,
)
"""Their effect grows with the length of the rollout, so steps shrink with it."""


@dataclass(frozen=True, eq=False)
class Sample:
    """One direction in one state.

    Attributes:
        ours: directional derivative of the adjoint
        theirs: that of the differences
        scale: the larger of the gradient's length and of the least one that is told from 0: so long
            that half the bound is what rounding leaves of the differences with the middle step
        doubt: how well the differences know the derivative, as a share of `scale`; None: no step is
            so small that it crosses no branch, or the state lies on the edge of one
        fired: how often constraints of each `Kind` acted in the state
        growth: the gradient by positions over that which the loss has at the end
    """

    parameter: str
    ours: float
    theirs: float
    scale: float
    doubt: float | None
    fired: np.ndarray
    growth: float

    @property
    def error(self) -> float:
        return abs(self.ours - self.theirs) / self.scale


def compare(
    run: DifferentiableRollout,
    worlds: Worlds,
    draw: Draw,
    substeps: int,
    rng: np.random.Generator,
    *,
    bound: float,
    directions: int = 1,
) -> list[Sample]:
    """Roll on from `draw` for so many substeps and compare derivatives of a random loss along so
    many random directions of every array, and along every number.

    Args:
        bound: error that is asked about; what cannot be told from 0 so well counts as that large,
            and the ladders start the lower the larger it is
    """
    for world in range(WORLDS):
        worlds.restore(world, draw.state)
    usual = float(worlds.solver.data.per_world("group.damping", 0)[0])
    base, loss = _base(worlds, draw.path), Loss.draw(worlds, rng)
    names = [
        name
        for name, value in base.items()
        for _ in range(1 if name in WORLD_PARAMETERS else directions)
        if value.size
    ]
    along = [_direction(name, base[name], rng) for name in names]
    samples: list[Sample] = []
    for first in range(0, len(names), CHUNK):
        part = slice(first, first + CHUNK)
        samples += _compare_some(
            run, worlds, draw, substeps, base, loss, names[part], along[part], bound
        )
    for w in range(WORLDS):
        worlds.solver.set_world(w, damping=usual)
    return samples


def fired(run: DifferentiableRollout, worlds: Worlds, draw: Draw) -> np.ndarray:
    """How often constraints of each kind act in the next substep."""
    worlds.restore(0, draw.state)
    touching_of(worlds, 0)[:] = draw.touching
    paths = {} if draw.path is None else {0: draw.path}
    run.forward([0], [worlds.solver.config.dt], paths=paths)
    return run.backward(parts=False).fired[0]


def _compare_some(
    run: DifferentiableRollout,
    worlds: Worlds,
    draw: Draw,
    substeps: int,
    base: dict[str, np.ndarray],
    loss: Loss,
    names: Sequence[str],
    along: Sequence[np.ndarray],
    bound: float,
) -> list[Sample]:
    count = 1 + 2 * len(names)
    shorter = np.sqrt(1e-6 / bound)
    steps = [STEPS[n] * shorter / (substeps if n in _GROWING else 1) for n in names]
    changes, second = np.zeros((2, DEEPEST, len(names)))
    same = np.zeros((DEEPEST, len(names)), dtype=bool)
    depths, noise, values = np.full(len(names), DEEPEST), 0.0, [np.zeros(0)]
    gradients: Gradients | None = None
    middle: tuple[np.ndarray, np.ndarray] | None = None
    for rung in range(DEEPEST):
        if rung == RUNGS:
            assert gradients is not None
            noise = _noise(loss, second[rung - 1][same[rung - 1]])
            values = [_gradient(gradients, name, base) for name in names]
            depths = _depths(np.array(steps), values, noise, same[:RUNGS], bound)
        if rung == depths.max():
            break
        moved = {name: [base[name]] * count for name in base}
        for k, (name, direction) in enumerate(zip(names, along, strict=True)):
            step = steps[k] / RATIO**rung
            moved[name][2 * k + 1] = _moved(name, base[name], step * direction)
            moved[name][2 * k + 2] = _moved(name, base[name], -step * direction)
        ends, words, counts, of_moved = roll(run, worlds, draw, substeps, moved, loss)
        gradients = gradients or of_moved
        middle = middle or (words[0], counts[0])
        for k in range(len(names)):
            pair = (2 * k + 1, 2 * k + 2)
            changes[rung, k] = loss.change(ends, *pair)
            second[rung, k] = loss.change(ends, pair[0], 0) + loss.change(ends, pair[1], 0)
            same[rung, k] = all(
                np.array_equal(words[i], middle[0]) and (counts[i] == middle[1]).all()
                for i in (0, *pair)
            )
    put_back(worlds, base, WORLDS)
    assert gradients is not None
    growth = float(np.linalg.norm(gradients.positions[0])) / loss.size()
    samples = []
    for k, (name, value, direction) in enumerate(zip(names, values, along, strict=True)):
        ladder = steps[k] / RATIO ** np.arange(depths[k])
        # rungs above a crossing are no use, even where the branches happen to be the same
        crossing = np.flatnonzero(~same[: depths[k], k])
        smooth = slice(int(crossing[-1]) + 1 if len(crossing) else 0, depths[k])
        scale = max(float(np.linalg.norm(value)), 2 * noise / ladder[RUNGS // 2] / bound)
        theirs, doubt = np.nan, None
        if smooth.start < depths[k]:
            theirs, unknown = central(changes[smooth, k], ladder[smooth], noise)
            bent, by = kink(second[smooth, k], ladder[smooth], noise)
            if abs(bent) < max(KINK * scale, 3 * by):
                doubt = unknown / scale
        samples.append(
            Sample(
                parameter=name,
                ours=float((value * direction).sum()),
                theirs=theirs,
                scale=scale,
                doubt=doubt,
                fired=gradients.fired[0],
                growth=growth,
            )
        )
    return samples


def _noise(loss: Loss, second: np.ndarray) -> float:
    """What rounding leaves of a loss, by second differences (n,) with the smallest steps: contacts
    magnify it, and these show hardly anything else.
    """
    measured = float(np.median(np.abs(second))) if len(second) else 0.0
    return max(EPSILON * loss.size(), measured)


def _depths(
    steps: np.ndarray, values: Sequence[np.ndarray], noise: float, same: np.ndarray, bound: float
) -> np.ndarray:
    """How many rungs each ladder has, by what the first of them (rungs, n) crossed."""
    finest = noise / (bound * np.array([max(float(np.linalg.norm(v)), 1e-300) for v in values]))
    most = np.floor(np.log(steps / finest) / np.log(RATIO)).astype(int) + 1
    crossed = ~same[-SMOOTH_RUNGS:].all(axis=0)
    return np.where(crossed, np.clip(most, RUNGS, DEEPEST), RUNGS)


def _base(worlds: Worlds, path: GripPath | None) -> dict[str, np.ndarray]:
    """Values of all parameters in world 0; those of a path where there is one."""
    data = worlds.solver.data
    poses, twists = data.body_poses(0)
    values = {
        "positions": data.lane("particles.x", 0).astype(float),
        "velocities": data.lane("particles.v", 0).astype(float),
        "inverse_masses": data.lane("particles.w0", 0).astype(float),
        "body_poses": poses,
        "body_velocities": twists,
        "body_inverse_masses": data.arrays["bodies.w0"].view[data.body_rows(0)].copy(),
    }
    if path is not None:
        values["waypoints"] = np.asarray(path.positions, dtype=float)
        values["knot_times"] = np.asarray(path.times, dtype=float)
        if path.rotations is not None:
            values["knot_rotations"] = np.asarray(path.rotations, dtype=float)
    for name in WORLD_PARAMETERS:
        values[name] = data.per_world(f"group.{name}", 0).astype(float).reshape(())
    values["damping"] = np.maximum(values["damping"], AIR)
    values |= {name: parts(data, 0, name).astype(float) for name in PARTS}
    return values


def _direction(name: str, base: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Random; of poses in the tangent space (B, 6), turns by rotation vectors times `ARM`."""
    if name in WORLD_PARAMETERS:
        return np.minimum(1.0, base / (2 * STEPS[name]))  # they stay positive
    direction = rng.normal(size=(len(base), 6) if name == "body_poses" else base.shape)
    if name in PARTS:
        return direction * (base > 0)  # a bend around none stays one
    if name == "knot_times":
        direction[0] = 0.0  # paths start at time 0
    return direction


def _moved(name: str, base: np.ndarray, by: np.ndarray) -> np.ndarray:
    """`base` after a step in the units of directions."""
    if name in _SHARES:
        return base * (1 + by)
    if name == "body_velocities":
        return base + by * _TWIST
    if name == "body_poses":
        turn = base[:, 3:] + np.einsum("bk,bkq->bq", by[:, 3:] / ARM, quat_by_rotation(base[:, 3:]))
        turn /= np.linalg.norm(turn, axis=1, keepdims=True)
        return np.column_stack([base[:, :3] + by[:, :3], turn])
    return base + by


def _gradient(gradients: Gradients, name: str, base: dict[str, np.ndarray]) -> np.ndarray:
    """Of world 0, in the units of directions."""
    value = np.asarray(getattr(gradients, name)[0])
    if name in _SHARES:
        return value * base[name]
    if name in PARTS:
        return value * (base[name] > 0)
    if name == "body_velocities":
        return value * _TWIST
    if name == "body_poses":
        turn = np.einsum("bq,bkq->bk", value[:, 3:], quat_by_rotation(base[name][:, 3:])) / ARM
        return np.column_stack([value[:, :3], turn])
    if name == "knot_times":
        return value * (np.arange(len(value)) > 0)
    return value


_SHARES = ("inverse_masses", "body_inverse_masses", "spring_stiffness")
_TWIST = np.array([1.0] * 3 + [1 / ARM] * 3)
