"""A bag and a cube of your own scene: the bag is lifted by its rim, and the cube goes with it.

    python examples/carry_item.py [--out carry.png]

The tip holds one bead of the rim; friction and the shell do the rest.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import newton
import numpy as np

from warp_deform.objects import BagConfig, BoxConfig, BoxPart, add_bag, add_box
from warp_deform.quiet import quiet_warp
from warp_deform.rendering.camera import look_at
from warp_deform.rendering.drawables import Drawables
from warp_deform.rendering.scene_view import SceneView
from warp_deform.rendering.video import write_png
from warp_deform.rollout import GripPath, rollout
from warp_deform.solver import SolverFusedXPBD
from warp_deform.tasks.bag_physics import BAG_SOLVER

LIFT, SPEED, WAY = 0.40, 0.25, 0.30  # [m], [m/s], [m] along y


def main(out: Path | None = None) -> float:
    """Carry the bag; returns how far the cube ends from the middle of the bag [m]."""
    bag = BagConfig()
    cube = BoxConfig(parts=(BoxPart((0.036, 0.036, 0.036)),), mass=0.02, friction=1.5)
    pose = np.eye(4)
    pose[:3, 3] = 0.5, -WAY / 2, bag.radius + bag.shell_radius

    builder = newton.ModelBuilder()
    SolverFusedXPBD.register_custom_attributes(builder)
    shell = add_bag(builder, bag, pose)
    item = add_box(builder, cube, (0.5, -WAY / 2, 0.03 - cube.lowest))
    solver = SolverFusedXPBD(builder.finalize(device="cpu"), BAG_SOLVER)
    # the bag sinks a little, the cube drops into it
    rollout(solver, [0], min_seconds=1.0, max_seconds=3.0)

    bead = shell.ring[0]
    start = solver.particle_q(0)[bead].astype(float)
    up, way = np.array([0.0, 0.0, LIFT]), np.array([0.0, WAY, 0.0])
    down = np.array([*(start + way)[:2], bag.bead_radius])
    # a pause at the top and one before the descent let the bag stop swinging
    knots = np.array([start, start + up, start + up, start + up + way, start + up + way, down])
    lengths = np.linalg.norm(np.diff(knots, axis=0), axis=1)
    times = np.concatenate([[0.0], np.cumsum(np.where(lengths > 0, lengths / SPEED, 0.3))])
    # the descent ends where what is held touches something
    path = GripPath(times, knots, particle=bead, lower=(times[-2], times[-1]))
    options = {"max_seconds": times[-1] + 4.0, "calm_after": 0.2, "record": 0.1}
    result = rollout(solver, [0], paths={0: path}, min_seconds=0.3, **options)[0]

    assert not result.watch.problems(0, solver.config.limits) and result.frames is not None
    highest = result.frames.body_q[:, 0, 2].max()
    box, vertices = solver.body_q(0), solver.particle_q(0)
    off = float(np.linalg.norm(box[0, :2] - vertices[:, :2].mean(axis=0)))
    print(f"the cube was up to {highest:.2f} m high and lies {1e3 * off:.0f} mm off the middle")
    assert highest > 0.1 and off < bag.radius, "the cube fell out"
    assert abs(box[0, 1] - WAY / 2) < 0.15, "the cube is not where it was carried"

    if out is not None:
        camera = look_at((1.1, -0.4, 0.6), (0.5, 0.0, 0.03), size=(480, 640), vertical_fov=0.7)
        frame = SceneView(camera=camera).render(Drawables.of([shell, item]), vertices, box)
        write_png(out, frame)
        print(f"wrote {out}")
    return off


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, help="picture at the end (PNG)")
    quiet_warp()
    main(parser.parse_args().out)
