"""A task of your own in one file: gather a straight cable into a small disc.

    python examples/own_task.py [--seed 0]

Add the class to `warp_deform.tasks.registry.TASKS` and the test suite, the command line and the
Gymnasium ids know it, too.
"""

from __future__ import annotations

import argparse

import numpy as np

from warp_deform import PickPlaceEnv
from warp_deform.objects import CableConfig, add_cable, cable_line, ring_zone
from warp_deform.quiet import quiet_warp
from warp_deform.tasks.demonstrators import pick_place
from warp_deform.tasks.task import Layout, Stage, Task

RADIUS = 0.06  # [m] of the disc
CABLE = CableConfig()


class CableGather(Task):
    """Nine of ten beads have to lie in the disc whose rim is marked."""

    name = "cable-gather"
    stages = (Stage(lift=0.04, speed=0.15),)
    success_score = 0.9
    ground_truth_size = 2 * CABLE.beads + 2
    objects = ("cable",)

    def add_objects(self, builder):
        return (add_cable(builder, CABLE, cable_line(CABLE, (0.5, -0.17), (0.5, 0.17))),)

    def sample(self, rng, space):
        x, y, yaw = space.sample(rng, CABLE.length, CABLE.length, extent=CABLE.length / 2)
        middle = np.array([x, y])
        half = CABLE.length / 2 * np.array([np.cos(yaw), np.sin(yaw)])
        beads = cable_line(CABLE, tuple(middle - half), tuple(middle + half))
        angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
        rim = middle + RADIUS * np.column_stack([np.cos(angle), np.sin(angle)])
        return Layout(beads, np.zeros((0, 7)), middle, (ring_zone(rim),),
                      settle_seconds=0.5)  # fmt: skip

    def score(self, layout, snapshot):
        distance = np.linalg.norm(snapshot.particle_q[:, :2] - layout.targets, axis=1)
        return float(np.mean(distance < RADIUS))

    def demonstrate(self, layout, snapshot, rng):
        outward = snapshot.particle_q[:, :2] - layout.targets
        distance = np.linalg.norm(outward, axis=1)
        bead = int(distance.argmax())
        beyond = layout.targets - outward[bead] / distance[bead] * RADIUS / 2
        return pick_place(snapshot.particle_q[bead], beyond, stage=self.stages[0])

    def ground_truth(self, layout, snapshot):
        beads = snapshot.particle_q[:, :2].ravel()
        return np.concatenate([beads, layout.targets]).astype(np.float32)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    quiet_warp()
    env = PickPlaceEnv(CableGather())
    _, info = env.reset(seed=options.seed)
    terminated = truncated = False
    while not (terminated or truncated) and (action := env.demonstrate()) is not None:
        _, reward, terminated, truncated, info = env.step(action)
        print(f"{info['outcome']}: score {info['score']:.2f} ({reward:+.2f})")
    assert info["success"], "the demonstrator did not solve its task"


if __name__ == "__main__":
    main()
