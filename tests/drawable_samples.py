"""Things to draw, for the tests of the renderers."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from warp_deform.rendering.drawables import Drawables

TABLE = 51


def drawables(*, spheres=(), boxes=(), quads=(), triangles=(), links=()):
    """Drawables of (radius), (half sides), (4 corners) and (3 particles); ids count from 4."""
    ids = iter(range(4, 256))
    count = len(spheres) + len(boxes) + len(quads) + (1 if len(triangles) else 0)
    palette = np.zeros((256, 3), np.uint8)
    palette[1] = TABLE
    palette[4 : 4 + count] = np.random.default_rng(1).integers(90, 255, (count, 3))
    sphere_segment = np.array([next(ids) for _ in spheres], np.int32)
    return Drawables(
        sphere_particle=np.arange(len(spheres), dtype=np.int32),
        sphere_radius=np.array(spheres, np.float32),
        sphere_segment=sphere_segment,
        box_body=np.arange(len(boxes), dtype=np.int32),
        box_pose=np.tile(np.array([0, 0, 0, 0, 0, 0, 1], np.float32), (len(boxes), 1)),
        box_half=np.array(boxes, np.float32).reshape(-1, 3),
        box_segment=np.array([next(ids) for _ in boxes], np.int32),
        quad_corners=np.array(quads, np.float32).reshape(-1, 4, 3),
        quad_segment=np.array([next(ids) for _ in quads], np.int32),
        palette=palette,
        segments=(),
        triangle_particle=np.array(triangles, np.int32).reshape(-1, 3),
        triangle_segment=np.full(len(triangles), next(ids), np.int32),
        link_particle=np.array(links, np.int32).reshape(-1, 2),
        link_radius=np.full(len(links), 0.004, np.float32),
        link_segment=np.full(len(links), 4, np.int32),
    )


NO_BODIES = np.zeros((0, 7))
NO_PARTICLES = np.zeros((0, 3))


def scene():
    """Ten spheres, some of them in a heap, three tilted boxes, a mark and a small sheet."""
    rng = np.random.default_rng(0)
    spheres = np.column_stack(
        [rng.uniform(0.3, 0.45, 10), rng.uniform(-0.2, 0.0, 10), rng.uniform(0.005, 0.03, 10)]
    )
    # nothing passes exactly through a pixel's centre, where rounding would decide
    sheet = 0.0007 + np.array(
        [[0.5, 0.3, 0.05], [0.62, 0.31, 0.02], [0.6, 0.44, 0.06], [0.48, 0.4, 0.01]]
    )
    body_q = np.column_stack(
        [
            [[0.6, -0.2, 0.05], [0.55, 0.1, 0.04], [0.35, 0.3, 0.03]],
            Rotation.random(3, rng=rng).as_quat(),
        ]
    )
    mark = [[0.301, 0.1, 0.001], [0.42, 0.123, 0.001], [0.41, 0.2, 0.001], [0.29, 0.19, 0.001]]
    shown = drawables(
        spheres=rng.uniform(0.006, 0.02, 10),
        boxes=[[0.04, 0.02, 0.03], [0.02, 0.02, 0.02], [0.01, 0.05, 0.02]],
        quads=[mark],
        triangles=[[10, 11, 12], [10, 12, 13]],
    )
    return shown, np.concatenate([spheres, sheet]), body_q
