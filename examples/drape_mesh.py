"""Drape a mesh over a box: a T-shirt cut out here, or a surface of yours from a file.

    python examples/drape_mesh.py [shirt.obj] [--out drape.png]

The mesh is an open surface in metres with edges of similar length; it is laid 8 cm above the table.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import newton
import numpy as np
import trimesh

from warp_deform.objects import BoxConfig, BoxPart, ClothConfig, add_box, add_cloth_mesh
from warp_deform.quiet import quiet_warp
from warp_deform.rendering.camera import look_at
from warp_deform.rendering.drawables import Drawables
from warp_deform.rendering.scene_view import SceneView
from warp_deform.rendering.video import write_png
from warp_deform.rollout import rollout
from warp_deform.solver import SolverFusedXPBD
from warp_deform.tasks.cloth_physics import CLOTH_SOLVER

CELL = 0.0125  # [m]


def t_shirt() -> trimesh.Trimesh:
    """A flat T: the body 0.10 m wide and 0.20 m long, sleeves of 0.075 m."""
    body = [(column, row) for column in range(8) for row in range(16)]
    sleeves = [(column, row) for column in (*range(-6, 0), *range(8, 14)) for row in range(10, 16)]
    cells = np.array(body + sleeves)
    corners = cells[:, None] + [[0, 0], [1, 0], [1, 1], [0, 1]]
    points, number = np.unique(corners.reshape(-1, 2), axis=0, return_inverse=True)
    quads = number.reshape(-1, 4)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return trimesh.Trimesh(np.column_stack([CELL * points, np.zeros(len(points))]), faces)


def main(path: Path | None = None, out: Path | None = None) -> np.ndarray:
    """Drape the mesh; returns its vertices at rest (P, 3) [m]."""
    mesh = t_shirt() if path is None else trimesh.load(path, force="mesh")
    pose = np.eye(4)
    pose[:3, 3] = np.array([0.5, 0.0, 0.08]) - mesh.bounds.mean(axis=0)
    block = BoxConfig(parts=(BoxPart((0.06, 0.06, 0.06)),), mass=1.0)

    builder = newton.ModelBuilder()
    SolverFusedXPBD.register_custom_attributes(builder)
    cloth = add_cloth_mesh(builder, ClothConfig(), mesh, pose)
    objects = [cloth, add_box(builder, block, (0.5, 0.0, 0.03))]
    solver = SolverFusedXPBD(builder.finalize(device="cpu"), CLOTH_SOLVER)
    result = rollout(solver, [0], min_seconds=1.0, max_seconds=6.0)[0]

    x, box = solver.particle_q(0), solver.body_q(0)
    assert not result.watch.problems(0, solver.config.limits)
    # it covers the box, and what overhangs has come down
    assert x[:, 2].max() < 0.06 + 0.01 and x[:, 2].min() < 0.03, (x[:, 2].min(), x[:, 2].max())
    print(f"{len(x)} vertices, {result.seconds:.2f} s; {np.mean(x[:, 2] > 0.06):.0%} on the box")

    if out is not None:
        camera = look_at((0.85, -0.40, 0.40), (0.5, 0.0, 0.03), size=(480, 640), vertical_fov=0.5)
        write_png(out, SceneView(camera=camera).render(Drawables.of(objects), x, box))
        print(f"wrote {out}")
    return x


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("mesh", type=Path, nargs="?", help="OBJ, PLY or STL; else a T-shirt")
    parser.add_argument("--out", type=Path, help="picture of the drape (PNG)")
    options = parser.parse_args()
    quiet_warp()
    main(options.mesh, options.out)
