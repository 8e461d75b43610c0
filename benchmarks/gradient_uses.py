"""What the adjoint buys in the examples: beside searches without slopes, on the same problems.

    python benchmarks/gradient_uses.py [--seeds 3] [--quick] [--json]

Identification (examples/identify_cable.py): its fit by L-BFGS with slopes of the adjoint, the same
with finite differences, and Nelder-Mead, all on ever more of the recording. Trajectory
(examples/straighten_cable.py): its Adam, and the cross-entropy method with as many rollouts; a
rollout with slopes counts as `--cost` plain ones (benchmarks/gradients.py says how many it costs).
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
import identify_cable
import straighten_cable

from warp_deform.collecting.workers import single_threaded
from warp_deform.quiet import quiet_warp

GENERATION, ELITES = 20, 5
"""Draws of the cross-entropy method a generation, and how many of them the next is drawn around."""
SPREAD = 0.02
"""Its first standard deviation of a waypoint [m]."""


@dataclass(frozen=True)
class Identified:
    """Errors of the parameters by name, relative to the truth; rollouts, with slopes or without."""

    method: str
    errors: dict[str, float]
    rollouts: int


@dataclass(frozen=True)
class Straightened:
    """How far the cable lies off the line [m], fastest speed of the pull [m/s], plain rollouts."""

    method: str
    off: float
    speed: float
    rollouts: float


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--seeds", type=int, default=3, help="of the cross-entropy method")
    parser.add_argument("--cost", type=float, default=2.5, help="of a rollout with slopes")
    parser.add_argument("--quick", action="store_true", help="a smoke run; not for publication")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    quiet_warp()
    with single_threaded():
        fits = identify(quick=options.quick)
        pulls = straighten(options.seeds, options.cost, quick=options.quick)
    if options.json:
        both = {"identify": fits, "straighten": pulls}
        print(json.dumps({name: [asdict(row) for row in rows] for name, rows in both.items()}))
        return
    print("| fit | " + " | ".join(identify_cable.NAMES) + " | rollouts |\n" + "|---" * 6 + "|")
    for row in fits:
        cells = " | ".join(f"{100 * error:+.1f} %" for error in row.errors.values())
        print(f"| {row.method} | {cells} | {row.rollouts} |")
    print("\n| pull | off the line | fastest | rollouts |\n|---|---|---|---|")
    for pull in pulls:
        print(
            f"| {pull.method} | {1e3 * pull.off:.1f} mm | {pull.speed:.2f} m/s "
            f"| {pull.rollouts:.0f} |"
        )


def identify(*, quick: bool) -> list[Identified]:
    """Fits from the example's guess to the example's recording."""
    pull = identify_cable.Pull()
    seen = identify_cable.record(pull)
    rows = []
    for name, fit in {"slopes": identify_cable.fit, **_WITHOUT}.items():
        pull.calls = 0
        fitted = np.full(4, np.nan) if quick and name != "slopes" else fit(pull, seen)
        errors = dict(zip(identify_cable.NAMES, fitted / identify_cable.TRUE - 1, strict=True))
        rows.append(Identified(name, {n: float(e) for n, e in errors.items()}, pull.calls))
    return rows


def _without_slopes(method: str, evaluations: int) -> Callable[..., np.ndarray]:
    """The example's fit by a method that asks for losses only."""

    def fit(pull: identify_cable.Pull, seen: np.ndarray) -> np.ndarray:
        def loss(logs: np.ndarray, shown: np.ndarray, scale: float) -> float:
            error = (pull.simulate(np.exp(logs), shown.shape[1]) - shown) / scale
            return float((np.sqrt(1 + error**2) - 1).mean())

        noise, logs = identify_cable.NOISE, np.log(identify_cable.GUESS)
        stages = [(frames, 6 * noise, evaluations) for frames in range(2, seen.shape[1], 2)]
        for frames, scale, most in [*stages, (seen.shape[1], noise, 10 * evaluations)]:
            key = "maxfev" if method == "Nelder-Mead" else "maxfun"
            logs = minimize(
                loss,
                logs,
                (seen[:, :frames], scale),
                method,
                bounds=[(-4, 3)] * 4,
                options={key: most},
            ).x
        return np.exp(logs)

    return fit


_WITHOUT = {
    "finite differences": _without_slopes("L-BFGS-B", 60),
    "Nelder-Mead": _without_slopes("Nelder-Mead", 60),
}


def straighten(seeds: int, cost: float, *, quick: bool) -> list[Straightened]:
    """The example's pulls, and those of the cross-entropy method at the same cost."""
    pull, s = straighten_cable.Pull(), straighten_cable
    budget = s.STEPS * (1 + cost)

    def row(name: str, knots: np.ndarray, rollouts: float) -> Straightened:
        speed = np.linalg.norm(np.diff(knots, axis=0), axis=1) / np.diff(s.TIMES)
        return Straightened(name, s.off(pull.simulate(knots)), float(speed.max()), rollouts)

    rows = [row("straight", s.DIRECT, 0), row("guess", s.DETOUR, 0)]
    if quick:
        return rows
    rows.append(row("Adam, slopes", s.descend(pull, s.DETOUR), budget))
    for seed in range(seeds):
        pulled = _drawn(pull, int(budget), np.random.default_rng(seed))
        rows.append(row(f"cross-entropy, seed {seed}", pulled, budget))
    return rows


def _drawn(pull: straighten_cable.Pull, budget: int, rng: np.random.Generator) -> np.ndarray:
    """The best waypoints that the cross-entropy method comes by."""
    s = straighten_cable

    def loss(knots: np.ndarray) -> float:  # as the example's
        speed = np.linalg.norm(np.diff(knots, axis=0), axis=1) / np.diff(s.TIMES)
        haste = 0.01 * (np.maximum(speed / s.FASTEST - 1, 0) ** 2).mean()
        return float(s.off(pull.simulate(knots)) ** 2 + haste)

    best = loss(s.DETOUR), s.DETOUR
    mean, spread = s.DETOUR[1:-1].copy(), np.full_like(s.DETOUR[1:-1], SPREAD)
    for _ in range(budget // GENERATION):
        drawn = mean + spread * rng.normal(size=(GENERATION, *mean.shape))
        paths = [np.vstack([s.DETOUR[:1], knots, s.DETOUR[-1:]]) for knots in drawn]
        losses = np.array([loss(path) for path in paths])
        order = np.argsort(losses)
        if losses[order[0]] < best[0]:
            best = losses[order[0]], paths[order[0]]
        elites = drawn[order[:ELITES]]
        mean, spread = elites.mean(axis=0), 0.3 * spread + 0.7 * elites.std(axis=0) + 5e-4
    return best[1]


if __name__ == "__main__":
    main()
