"""A task of your own with a mesh: fold the sleeves of a T-shirt over its body.

Its demonstrator draws a pull at random; `mpc` simulates eight of them at a time and takes the best.

python examples/fold_shirt.py
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import trimesh

from warp_deform.objects import ClothConfig, add_cloth_mesh
from warp_deform.planning.demonstrators import demonstrator
from warp_deform.quiet import quiet_warp
from warp_deform.tasks.cloth_physics import CLOTH_SOLVER, FABRIC_PRIMITIVE
from warp_deform.tasks.demonstrators import pick_place
from warp_deform.tasks.task import Layout, Stage, Task
from warp_deform.worlds import Worlds
from warp_deform.worlds.loop import play

CELL, NEAR = 0.0125, 0.02  # [m]
FRICTION = 2.0  # a smooth table would let the shirt slide along with its sleeve
CELLS = [[(c, r)] for c in range(-10, 10) for r in range(-8, 8) if -4 <= c < 4 or r >= 2]
CORNERS = np.add(CELLS, [[0, 0], [1, 0], [1, 1], [0, 1]])
GRID, NUMBER = np.unique(CORNERS.reshape(-1, 2), axis=0, return_inverse=True)
FACES = NUMBER.reshape(-1, 4)[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
SHIRT = trimesh.Trimesh(CELL * np.column_stack([GRID, np.zeros(len(GRID))]), FACES, process=False)
SLEEVES = np.flatnonzero(np.abs(GRID[:, 0]) > 4)
CUFFS = np.flatnonzero(np.abs(GRID[:, 0]) == 10)


class FoldShirt(Task):
    """Sleeve vertices have to lie within 2 cm of their mirror images about the seams."""

    name, objects = "fold-shirt", ("t-shirt",)
    stages = (Stage(lift=0.04, speed=0.08), Stage(lift=0.08, speed=0.15))
    success_score, ground_truth_size = 0.8, 2 * len(GRID)
    solver, primitive = replace(CLOTH_SOLVER, table_friction=FRICTION), FABRIC_PRIMITIVE

    def add_objects(self, builder):
        return (add_cloth_mesh(builder, ClothConfig(), SHIRT),)

    def sample(self, rng, space):
        x, y, _ = space.sample(rng, 20 * CELL, 16 * CELL, extent=10 * CELL)
        points, targets = np.add(SHIRT.vertices, [x, y, 0.004]), SHIRT.vertices[:, :2].copy()
        targets[SLEEVES, 0] = np.sign(targets[SLEEVES, 0]) * 8 * CELL - targets[SLEEVES, 0]
        return Layout(points, np.zeros((0, 7)), np.add(targets, [x, y]), settle_seconds=0.3)

    def score(self, layout, snapshot):
        return float(np.mean(self._distance(layout, snapshot)[SLEEVES] < NEAR))

    def demonstrate(self, layout, snapshot, rng):
        far = self._distance(layout, snapshot)[CUFFS]
        cuff = rng.choice(CUFFS[far > NEAR]) if (far > NEAR).any() else CUFFS[np.argmax(far)]
        end = self._targets(layout, snapshot)[cuff] + rng.normal(0.0, NEAR, 2)
        return pick_place(snapshot.particle_q[cuff], end, stage=rng.choice(self.stages))

    def ground_truth(self, layout, snapshot):
        return snapshot.particle_q[:, :2].ravel().astype(np.float32)

    def _distance(self, layout, snapshot):
        return np.linalg.norm(snapshot.particle_q[:, :2] - self._targets(layout, snapshot), axis=1)

    def _targets(self, layout, snapshot):
        moved = np.delete(snapshot.particle_q[:, :2] - layout.targets, SLEEVES, axis=0)
        return layout.targets + moved.mean(axis=0)


def main(seeds: range) -> None:
    worlds = Worlds(FoldShirt(), 8, lanes=8)
    for _, run in play(worlds, seeds, act=demonstrator("mpc"), look=Worlds.score):
        print(f"seed {run.seed}: {run.ended}, scores", *(f"{score:.2f}" for score in run.rows))


if __name__ == "__main__":
    quiet_warp()
    main(range(1))
