"""Throw a cable to a target, Newton's way: a `wp.Tape` around the steps, Warp's loss, gradients.

python examples/throw_with_tape.py

The same derivatives as `DifferentiableRollout` gives, which is faster and reaches more parameters.
"""

from itertools import pairwise

import newton
import numpy as np
import warp as wp

from warp_deform.objects import CableConfig, add_cable, cable_line
from warp_deform.quiet import quiet_warp
from warp_deform.rollout import DifferentiableRollout
from warp_deform.solver import SolverFusedXPBD

CABLE = CableConfig(beads=8)
START = np.add(cable_line(CABLE, (0.4, 0.0), (0.5, 0.0)), [0, 0, 0.3])
TARGET = np.array([0.55, 0.1, 0.15], np.float32)  # of the mean of the beads [m]
FRAMES, FRAME, RATE = 10, 1 / 60, 12.0  # steps of so many [s]; of the descent


@wp.kernel(enable_backward=True)
def add_up(q: wp.array(dtype=wp.vec3), mean: wp.array(dtype=wp.vec3)):
    wp.atomic_add(mean, 0, q[wp.tid()] / float(q.shape[0]))


@wp.kernel(enable_backward=True)
def squared(mean: wp.array(dtype=wp.vec3), target: wp.vec3, loss: wp.array(dtype=float)):
    loss[0] = wp.length_sq(mean[0] - target)


class Throw:
    """A cable in the air and a state for every frame of its flight."""

    def __init__(self) -> None:
        builder = newton.ModelBuilder()
        SolverFusedXPBD.register_custom_attributes(builder)
        add_cable(builder, CABLE, START)
        self.model = builder.finalize(device="cpu", requires_grad=True)
        self.solver = SolverFusedXPBD(self.model)
        self.states = [self.model.state(requires_grad=True) for _ in range(FRAMES + 1)]

    def loss(self, velocity: np.ndarray) -> tuple[float, np.ndarray]:
        """Squared distance [m^2] from the target after the flight, and its slope (3,)."""
        beads, value = len(START), wp.zeros(1, dtype=float, requires_grad=True)
        mean = wp.zeros(1, dtype=wp.vec3, requires_grad=True)
        self.states[0].particle_qd.assign(np.tile(velocity, (beads, 1)).astype(np.float32))
        with wp.Tape() as tape:
            for before, after in pairwise(self.states):
                self.solver.step(before, after, None, None, FRAME)
            wp.launch(add_up, dim=beads, inputs=[self.states[-1].particle_q, mean])
            wp.launch(squared, dim=1, inputs=[mean, wp.vec3(*TARGET), value])
        tape.backward(value)
        slope = self.states[0].particle_qd.grad.numpy().sum(axis=0)
        tape.zero()
        return float(value.numpy()[0]), slope


if __name__ == "__main__":
    quiet_warp()
    throw, velocity = Throw(), np.zeros(3)
    run = DifferentiableRollout(throw.solver)
    for step in range(6):
        value, slope = throw.loss(velocity)
        speeds = np.tile(velocity, (1, len(START), 1))
        end = run.forward([0], [FRAMES * FRAME], positions=START[None], velocities=speeds)
        by_mean = 2 * (end[0, 0].mean(axis=0) - TARGET) / len(START)
        same = run.backward(np.broadcast_to(by_mean, end.shape)).velocities[0].sum(axis=0)
        assert np.allclose(slope, same, rtol=1e-3, atol=1e-6)
        print(f"{step}: {1e3 * np.sqrt(value):.2f} mm off, thrown at {velocity.round(3)} m/s")
        velocity -= RATE * slope
    assert np.sqrt(throw.loss(velocity)[0]) < 1e-3
