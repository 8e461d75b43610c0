"""CPU time of a picture, against PyBullet's software renderer when it is installed.

    python benchmarks/rendering.py --json

Process CPU time in milliseconds, median and 95th percentile: the top-down picture (colour, height,
segmentation), one RGB-D camera of 480x640, the original's path (three of them, then fusion), and a
frame for people with the arm. PyBullet draws the same table, beads and a block at 640x480 without a
window and without an arm; its ratio counts three of its pictures where the original takes three.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable

import newton
import numpy as np

from warp_deform.objects import (
    RingConfig,
    add_box,
    add_cable,
    cable_ring,
    l_block,
    ring_zone,
    square_zone,
)
from warp_deform.rendering.camera import paper_cameras
from warp_deform.rendering.drawables import Drawables
from warp_deform.rendering.fusion import fuse
from warp_deform.rendering.perspective import Perspective
from warp_deform.rendering.scene_view import ArmMeshes, SceneView
from warp_deform.rendering.topdown import TopDown
from warp_deform.robots import robot


def scene() -> tuple[Drawables, np.ndarray, np.ndarray]:
    """A ring of 32 beads, an L-block and two zones."""
    builder = newton.ModelBuilder()
    config = RingConfig()
    ring = add_cable(builder, config, cable_ring(config, (0.5, 0.2)))
    block = add_box(builder, l_block(), (0.6, -0.05, 0.02), yaw=0.7)
    zones = [
        square_zone((0.6, 0.33), 0.4, 0.2),
        ring_zone(cable_ring(config, (0.38, -0.3))[:, :2]),
    ]
    drawables = Drawables.of([*zones, ring, block])
    model = builder.finalize(device="cpu")
    return drawables, model.particle_q.numpy().copy(), model.body_q.numpy().copy()


def measure(job: Callable[[], object], repeats: int) -> dict[str, float]:
    """Median and 95th percentile of the CPU time of `job` [ms], after one call that compiles."""
    job()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        job()
        times.append(1e3 * (time.process_time() - start))
    return {"p50_ms": float(np.median(times)), "p95_ms": float(np.percentile(times, 95))}


def pybullet_picture() -> Callable[[], object] | None:
    """PyBullet's software renderer on a scene as full as ours, or None where it is missing."""
    try:
        import pybullet
    except ImportError:
        return None
    client = pybullet.connect(pybullet.DIRECT)
    box, ball = pybullet.GEOM_BOX, pybullet.GEOM_SPHERE
    parts = [(box, [5, 5, 0.01], [0, 0, -0.02]), (box, [0.25, 0.5, 0.005], [0.5, 0, -0.005])]
    parts += [(box, [0.04, 0.015, 0.02], [0.6, -0.05, 0.02])]
    for kind, half, position in parts:
        shape = pybullet.createVisualShape(kind, halfExtents=half, physicsClientId=client)
        pybullet.createMultiBody(0, -1, shape, position, physicsClientId=client)
    bead = pybullet.createVisualShape(ball, radius=0.0075, physicsClientId=client)
    for position in cable_ring(RingConfig(), (0.5, 0.2)):
        pybullet.createMultiBody(0, -1, bead, list(position), physicsClientId=client)
    view = pybullet.computeViewMatrix([1.0, 0, 0.75], [0.5, 0, 0], [0, 0, 1])
    projection = pybullet.computeProjectionMatrixFOV(56.14, 640 / 480, 0.01, 10)
    return lambda: pybullet.getCameraImage(
        640,
        480,
        view,
        projection,
        shadow=1,
        renderer=pybullet.ER_TINY_RENDERER,
        physicsClientId=client,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=30, help="pictures of every kind")
    parser.add_argument("--json", action="store_true", help="one JSON object as the last line")
    arguments = parser.parse_args()
    drawables, particle_q, body_q = scene()
    cameras = paper_cameras()
    arm = robot("ur5")
    q = arm.solve_top_down(np.array([[0.5, 0.1, 0.1, 0.0]])).q[:1]
    links = ArmMeshes(arm.meshes()).at(arm.link_poses(q))
    top_down, perspective = TopDown(), Perspective()
    view = SceneView((480, 640))

    views = perspective.render(drawables, particle_q, body_q, cameras)

    def fusion() -> object:
        return fuse(
            [v.color for v in views],
            [v.depth for v in views],
            cameras,
            [v.segmentation for v in views],
        )

    jobs: dict[str, Callable[[], object] | None] = {
        "top_down_320x160": lambda: top_down.render(drawables, particle_q, body_q),
        "rgbd_480x640": lambda: perspective.render(drawables, particle_q, body_q, cameras[:1]),
        "rgbd_480x640_three_views": lambda: perspective.render(
            drawables, particle_q, body_q, cameras
        ),
        "fusion_of_three_views": fusion,
        "scene_480x640_with_arm": lambda: view.render(drawables, particle_q, body_q, links),
        "pybullet_480x640": pybullet_picture(),
    }
    rows = {name: measure(job, arguments.repeats) for name, job in jobs.items() if job}
    peer = rows.get("pybullet_480x640")
    for name, row in rows.items():
        ratio = ""
        if peer and name != "fusion_of_three_views":
            # the original renders three views for what one top-down picture or three views show
            views_of_peer = 3 if name in ("top_down_320x160", "rgbd_480x640_three_views") else 1
            row["pybullet_ratio"] = views_of_peer * peer["p50_ms"] / row["p50_ms"]
            ratio = f"   PyBullet / this {row['pybullet_ratio']:6.1f}"
        print(f"{name:26} p50 {row['p50_ms']:7.2f} ms   p95 {row['p95_ms']:7.2f} ms{ratio}")
    if arguments.json:
        print(json.dumps(rows))


if __name__ == "__main__":
    main()
