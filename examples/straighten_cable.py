"""Straighten a folded cable with one pull: Adam finds its waypoints by the adjoint's gradients.

python examples/straighten_cable.py

The end is led at about 0.3 m/s. Gradients are those of a damped rollout; the plain one judges.
"""

import newton
import numpy as np
import torch

from warp_deform.objects import CableConfig, add_cable, cable_line
from warp_deform.quiet import quiet_warp
from warp_deform.rollout import DifferentiableRollout, GripPath
from warp_deform.solver import SolverConfig, SolverFusedXPBD

CABLE = CableConfig(bend_stiffness=2.0)
LINE = cable_line(CABLE, (0.5, -0.16), (0.5, 0.2))
ROW, PLACE = np.divmod(np.arange(24), 8)
SIDE = CABLE.spacing * np.where(ROW % 2, 7 - PLACE, PLACE) - 0.05
FOLDS = np.column_stack([0.45 + 1.6 * CABLE.spacing * ROW, SIDE, LINE[:, 2]])
TIP, TAIL, GOAL = FOLDS[-1, :2], LINE[0, :2], LINE[-1, :2]
BEYOND = 1.5 * TAIL - 0.5 * GOAL  # half a cable before the line
DIRECT = np.linspace(TIP, GOAL, 17)
DETOUR = np.vstack([np.linspace(TIP, BEYOND, 7)[:6], np.linspace(BEYOND, GOAL, 11)])
TIMES = np.append(0.0, np.linspace(0.2, 4.2, 16))  # of the waypoints [s]
HEIGHT = CABLE.radius + np.pad(np.full(15, 0.03), 1)  # [m]
FASTEST, STEPS, DAMPING = 0.3, 80, 20.0  # [m/s]; of Adam; for gradients [1/s]


class Pull:
    """Lays out the cable in folds, and pulls it."""

    def __init__(self) -> None:
        builder = newton.ModelBuilder()
        SolverFusedXPBD.register_custom_attributes(builder)
        self.cable = add_cable(builder, CABLE, FOLDS)
        model, config = builder.finalize(device="cpu"), SolverConfig(contact_friction=0.1)
        self.run = DifferentiableRollout(SolverFusedXPBD(model, config, precision="float64"))

    def simulate(self, knots: np.ndarray, damping: float = 1.0) -> np.ndarray:
        """Beads (24, 3) [m] 0.4 s after a pull with the end 3 cm above the table."""
        path = GripPath(TIMES, np.column_stack([knots, HEIGHT]), particle=23)
        rest = {"positions": FOLDS[None], "velocities": np.zeros((1, 24, 3))}
        times, named = [TIMES[-1] + 0.4], {"damping": [damping]}
        return self.run.forward([0], times, paths={0: path}, parameters=named, **rest)[0, 0]


def descend(pull: Pull, guess: np.ndarray) -> np.ndarray:
    """The best waypoints that Adam comes by: near the line, and slow."""
    knots, best = torch.tensor(guess, requires_grad=True), (np.inf, guess)
    adam = torch.optim.Adam([knots], lr=0.03, betas=(0.9, 0.99))
    for step in range(STEPS):
        adam.param_groups[0]["lr"] = 0.03 * (1 - step / STEPS)
        now = knots.detach().numpy().copy()
        speed = torch.diff(knots, dim=0).norm(dim=1) / torch.tensor(np.diff(TIMES))
        haste = 0.01 * torch.relu(speed / FASTEST - 1).square().mean()  # [m^2], as the loss
        best = min(best, (off(pull.simulate(now)) ** 2 + haste.item(), now), key=lambda b: b[0])
        error = (pull.simulate(now, DAMPING) - LINE) * [1, 1, 0]
        by = pull.run.backward(2 / 24 * error[None, None]).waypoints[0][:, :2]
        knots.grad = torch.autograd.grad(haste, knots)[0] + torch.tensor(by)
        knots.grad[[0, -1]] = 0  # where the pull starts and ends is given
        torch.nn.utils.clip_grad_norm_([knots], 0.02)
        adam.step()
    return best[1]


def off(beads: np.ndarray) -> float:
    """Root mean squared distance of the beads from their places on the line [m]."""
    return float(np.sqrt(((beads - LINE)[:, :2] ** 2).sum(axis=1).mean()))


if __name__ == "__main__":
    quiet_warp()
    pull = Pull()
    for way, knots in {"straight": DIRECT, "guess": DETOUR, "found": descend(pull, DETOUR)}.items():
        beads = pull.simulate(knots)
        span = np.linalg.norm(beads[-1] - beads[0]) / (23 * CABLE.spacing)
        print(f"{way}: {1e3 * off(beads):.1f} mm off the line, {span:.1%} of the cable's length")
    assert off(beads) < 0.01 and span > 0.95
