"""Find a cord's frictions, damping and stiffness from a recording of one pull, by the adjoint.

    python examples/identify_cable.py

Hanging shows the stiffness, swinging the damping, dragging the friction on the table, and a loop
that closes that of the cord on itself. A guess far off is fitted to more and more of the recording.
"""

import newton
import numpy as np
from scipy.optimize import minimize

from warp_deform.objects import CableConfig, add_cable
from warp_deform.quiet import quiet_warp
from warp_deform.rollout import DifferentiableRollout, GripPath, rollout
from warp_deform.solver import SolverConfig, SolverFusedXPBD

CORD = CableConfig(mass=0.01, link_stiffness=600.0, fold_stiffness=300.0, bend_stiffness=1.0)
NAMES = ("table_friction", "contact_friction", "damping", "stiffness")
TRUE, GUESS = np.array([0.35, 0.2, 2.0, 1.0]), np.array([0.7, 0.05, 0.5, 3.0])
TIMES, NOISE = np.arange(1, 16) / 10, 0.5e-3  # of the recorded positions [s], [m]
LEAD = np.array([[0, 0, 0], [-5, -2, 20], [5, 10, 20], [15, 10, 1.5], [18, 15, 1.5]]) / 100  # [m]


class Pull:
    """A known pull of a cord whose parameters are not; `calls` counts simulations."""

    def __init__(self) -> None:
        bead = np.arange(CORD.beads)
        turn = np.cumsum(np.where((bead >= 5) & (bead < 19), 0.516, 0.0))
        xy = np.cumsum(CORD.spacing * np.column_stack([np.cos(turn), np.sin(turn)]), axis=0)
        over = 0.011 * np.clip((bead - 13) / 4, 0, 1)  # the end lies on the loop
        start = np.column_stack([xy + np.array([0.35, 0.0]), CORD.radius + over])
        SolverFusedXPBD.register_custom_attributes(builder := newton.ModelBuilder())
        self.cord = add_cable(builder, CORD, start)
        air, model = SolverConfig(damping=1.0), builder.finalize(device="cpu")
        solver = SolverFusedXPBD(model, air, precision="float64")
        rollout(solver, [0], min_seconds=1.0, max_seconds=1.0)
        self.start, self.calls = solver.particle_q(0), 0
        self.path = GripPath(np.array([0, 0.5, 0.8, 1.2, 1.5]), self.start[-1] + LEAD, particle=23)
        self.run = DifferentiableRollout(solver, storage="full")

    def simulate(self, parameters: np.ndarray, frames: int = len(TIMES)) -> np.ndarray:
        """Positions (1, frames, beads, 3) [m]."""
        self.calls += 1
        named = dict(zip(NAMES, parameters[:, None], strict=True))
        rest = {"positions": self.start[None], "velocities": np.zeros((1, CORD.beads, 3))}
        times, paths = TIMES[:frames], {0: self.path}
        return self.run.forward([0], times, paths=paths, parameters=named, **rest)

    def loss(self, logs: np.ndarray, seen: np.ndarray, scale: float) -> tuple[float, np.ndarray]:
        """Pseudo-Huber loss against the frames seen, and its gradient by the logarithms."""
        error = (self.simulate(np.exp(logs), seen.shape[1]) - seen) / scale
        root = np.sqrt(1 + error**2)
        by = self.run.backward(error / root / error.size / scale)
        return (root - 1).mean(), np.exp(logs) * [getattr(by, name)[0] for name in NAMES]


def fit(pull: Pull, seen: np.ndarray) -> np.ndarray:
    """Parameters by L-BFGS in their logarithms, ever more frames at a time."""
    logs = np.log(GUESS)
    for frames in range(2, len(TIMES), 2):
        limits = {"jac": True, "bounds": [(-4, 3)] * 4, "options": {"maxiter": 8}}
        logs = minimize(pull.loss, logs, (seen[:, :frames], 6 * NOISE), "L-BFGS-B", **limits).x
    return np.exp(minimize(pull.loss, logs, (seen, NOISE), "L-BFGS-B", jac=True).x)


def record(pull: Pull) -> np.ndarray:
    """The cord's true course, with noise."""
    return pull.simulate(TRUE) + np.random.default_rng(0).normal(0, NOISE, (1, 15, CORD.beads, 3))


if __name__ == "__main__":
    quiet_warp()
    pull = Pull()
    fitted = fit(pull, record(pull))
    for name, guess, value, true in zip(NAMES, GUESS, fitted, TRUE, strict=True):
        print(f"{name:>16}: guess {guess:.3f}, found {value:.4f}, true {true:.3f}")
    print(f"{pull.calls - 1} rollouts")
    assert (abs(fitted / TRUE - 1) < 0.02).all()
