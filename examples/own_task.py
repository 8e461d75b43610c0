"""A task of your own in one file: gather a straight cable into a small disc.

    python examples/own_task.py [--out DIR]

goes the whole way: demonstrations, film, replay, a short training, its test. On the command line:

    warp-deform demo cable-gather -n 10 --out demos --task-module examples/own_task.py
"""

import argparse
import tempfile

import numpy as np

from warp_deform import register_task
from warp_deform.command.main import main as warp_deform
from warp_deform.objects import CableConfig, add_cable, cable_line, ring_zone
from warp_deform.tasks.demonstrators import pick_place
from warp_deform.tasks.ground_truth import Row
from warp_deform.tasks.task import Layout, Stage, Task

RADIUS = 0.06  # [m] of the disc
CABLE = CableConfig()


@register_task
class CableGather(Task):
    """Nine of ten beads have to lie in the disc whose rim is marked."""

    name = "cable-gather"
    stages = (Stage(lift=0.04, speed=0.15),)
    success_score = 0.9
    ground_truth_rows = ((Row.POINT, CABLE.beads + 1),)
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
        return Layout(beads, np.zeros((0, 7)), middle, (ring_zone(rim),), settle_seconds=0.5)

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
        return np.vstack([snapshot.particle_q, [*layout.targets, 0.0]]).astype(np.float32).ravel()


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", default=tempfile.mkdtemp(), help="folder; a new one")
    out = parser.parse_args().out
    for command in (
        f"demo cable-gather -n 2 --workers 1 --out {out}/demos --video {out}/demo.mp4",
        f"replay {out}/demos --verify",
        f"train cable-gather --agent gt-mlp --data {out}/demos --out {out}/run "
        "--steps 50 --snapshots 1",
        f"eval {out}/run --episodes 1 --validation-episodes 1",
    ):
        print("warp-deform", command)
        assert warp_deform(command.split()) == 0, "a command did not do what was asked"


if __name__ == "__main__":
    main()
