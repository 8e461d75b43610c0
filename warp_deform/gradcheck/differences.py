"""Directional derivatives of short rollouts beside central differences, by the same worlds.

World 0 of a launch runs as drawn; two others run for every direction, moved by plus and minus a
small step. The adjoint of world 0 times the direction is compared with their difference.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..differentiable import DifferentiableRollout
from ..rollout import GripPath
from ..worlds import Worlds
from .draws import Draw

__all__ = ["FLOORS", "PARAMETERS", "STEPS", "WORLDS", "Sample", "compare"]

STEPS = {
    "positions": 1e-9,
    "velocities": 1e-7,
    "inverse_masses": 1e-5,
    "way_points": 1e-8,
    "knot_times": 1e-8,
    "damping": 1e-3,
    "table_friction": 1e-5,
    "contact_friction": 1e-5,
    "stiffness": 1e-4,
}
"""Steps of the differences, in SI units (inverse masses: as a share of each): so small that few
cross a branch, for contacts are a micrometre deep; so large that rounding stays below 1e-6."""
PARAMETERS = tuple(STEPS)
ROUNDING = 2e-15
"""What float64 leaves of a loss, whose terms are metres."""
FLOORS = {name: 1e5 * ROUNDING / step for name, step in STEPS.items()}
"""Errors of smaller gradients are relative to these: rounding alone would be 1e-5 of them."""
DIRECTIONS = 2
"""Random directions of arrays; numbers have one."""
_ARRAYS = PARAMETERS[:5]
_DIRECTIONS = [name for name in PARAMETERS for _ in range(DIRECTIONS if name in _ARRAYS else 1)]
WORLDS = 1 + 2 * len(_DIRECTIONS)
"""Worlds that `compare` uses."""


@dataclass(frozen=True, eq=False)
class Sample:
    """One state: pairs of directional derivatives by parameter.

    ours, theirs: of the adjoint and of the differences; size: the gradient's length
    smooth: whether constraints acted equally often in all of its worlds; else it is not compared
    fired: how often constraints of each `Kind` acted
    growth: the gradient by positions over that which the loss has at the end
    """

    parameter: str
    ours: float
    theirs: float
    size: float
    smooth: bool
    fired: np.ndarray
    growth: float

    @property
    def error(self) -> float:
        """Difference, relative to the larger of the gradient's length and the floor."""
        return abs(self.ours - self.theirs) / max(self.size, FLOORS[self.parameter])


def compare(
    run: DifferentiableRollout,
    worlds: Worlds,
    draw: Draw,
    seconds: float,
    rng: np.random.Generator,
) -> list[Sample]:
    """Roll on from `draw` for `seconds` and compare the derivatives of a random linear loss of
    positions and velocities (per substep) at the end, along random directions.
    """
    data, dt = worlds.solver.data, worlds.solver.config.dt
    for world in range(WORLDS):
        worlds.restore(world, draw.state)
    base = _base(worlds, draw.path)
    names = [name for name in _DIRECTIONS if name in base]
    moved = {name: np.repeat(base[name][None], WORLDS, axis=0) for name in set(names)}
    along = []
    for k, name in enumerate(names):
        direction = rng.normal(size=base[name].shape) * _scale(name, base[name])
        along.append(direction)
        moved[name][2 * k + 1] += STEPS[name] * direction
        moved[name][2 * k + 2] -= STEPS[name] * direction
    count = 1 + 2 * len(names)
    paths = {}
    if draw.path is not None:
        for w in range(count):
            positions, times = moved["way_points"][w], moved["knot_times"][w]
            paths[w] = replace(draw.path, positions=positions, times=times)
    parameters = {n: moved[n][:count] for n in (*PARAMETERS[5:], "inverse_masses")}
    ends = run.forward(
        range(count), [seconds], paths=paths, parameters=parameters,
        positions=moved["positions"][:count], velocities=moved["velocities"][:count],
    )[:, 0]  # fmt: skip
    speeds = np.stack([data.lane("particles.v", w) for w in range(count)])
    by_x = rng.normal(size=ends[0].shape)
    by_v = rng.normal(size=ends[0].shape) * dt
    each = np.ones((count, 1, 1, 1))
    gradients = run.backward(each * by_x, each * by_v)
    for world in range(WORLDS):
        worlds.solver.set_world(world, **{n: float(base[n]) for n in PARAMETERS[5:]})
        data.lane("particles.w0", world)[:] = base["inverse_masses"]
        data.lane("particles.w", world)[:] = base["inverse_masses"]
    growth = float(np.linalg.norm(gradients.positions[0]) / np.linalg.norm(by_x))
    samples = []
    for k, (name, direction) in enumerate(zip(names, along, strict=True)):
        value = getattr(gradients, name)[0]
        i, j = 2 * k + 1, 2 * k + 2
        # the difference first: less is lost to rounding
        change = (by_x * (ends[i] - ends[j])).sum() + (by_v * (speeds[i] - speeds[j])).sum()
        samples.append(
            Sample(
                parameter=name,
                ours=float((value * direction).sum()),
                theirs=float(change / (2 * STEPS[name])),
                size=float(np.linalg.norm(value * _scale(name, base[name]))),
                smooth=bool((gradients.fired[[i, j]] == gradients.fired[0]).all()),
                fired=gradients.fired[0],
                growth=growth,
            )
        )
    return samples


def _base(worlds: Worlds, path: GripPath | None) -> dict[str, np.ndarray]:
    """Values of all parameters in world 0; those of a path where there is one."""
    data = worlds.solver.data
    of_world = {
        n: data.per_world(f"group.{n}", 0).astype(float).reshape(()) for n in PARAMETERS[5:]
    }
    of_path = {}
    if path is not None:
        of_path["way_points"] = np.asarray(path.positions, dtype=float)
        of_path["knot_times"] = np.asarray(path.times, dtype=float)
    return {
        "positions": data.lane("particles.x", 0).astype(float),
        "velocities": data.lane("particles.v", 0).astype(float),
        "inverse_masses": data.lane("particles.w0", 0).astype(float),
        **of_path,
        **of_world,
    }


def _scale(name: str, base: np.ndarray) -> np.ndarray | float:
    """What one unit of a direction is: inverse masses change by shares, paths start at time 0."""
    if name == "inverse_masses":
        return base
    if name == "knot_times":
        return (np.arange(len(base)) > 0).astype(float)
    return 1.0
