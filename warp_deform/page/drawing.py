"""What the page draws: a scene as it stands, and the motion of one action.

Everything is from what the package's own pictures are drawn from: `Drawables`, the arm's meshes and
the poses of its links.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np

from ..objects.colors import BLUE, TABLE
from ..rendering.drawables import Drawables
from ..rendering.pixels import SHAPE, PixelGrid
from ..rendering.scene_view import LINK_COLORS
from ..robots.arm import Robot
from ..tasks.task import Snapshot
from ..worlds.arm_path import ArmPath
from ..worlds.episode import StepReport

__all__ = ["FRAMES_A_SECOND", "arm_arrays", "clip", "drawable_arrays", "grid_head", "heat_picture",
           "link_matrices", "pictures"]  # fmt: skip

FRAMES_A_SECOND = 30
_HIGH = 0.28
"""Height that the height map shows white [m]: the top of the workspace."""


def pictures(
    color: np.ndarray | None = None,
    height: np.ndarray | None = None,
    goal: np.ndarray | None = None,
) -> dict[str, np.ndarray]:
    """PNGs, as bytes, of those that are there: colour, height in grey, the goal's colour."""
    drawn = {}
    for name, rgb in (("color", color), ("goal", goal)):
        if rgb is not None:
            drawn[name] = _png(rgb[..., ::-1])
    if height is not None:
        # the square root, for most of what lies on the table is a centimetre high
        drawn["height"] = _png((255 * np.sqrt(np.clip(height / _HIGH, 0, 1))).astype(np.uint8))
    return drawn


def _png(picture: np.ndarray) -> np.ndarray:
    done, data = cv2.imencode(".png", picture, (cv2.IMWRITE_PNG_COMPRESSION, 3))
    if not done:
        raise RuntimeError(f"OpenCV cannot encode a picture of shape {picture.shape}")
    return np.asarray(data, np.uint8).ravel()


def grid_head(grid: PixelGrid) -> dict[str, Any]:
    """Which point of the table every pixel of a picture is, as JSON."""
    return {
        "origin": list(grid.origin),
        "pixel": grid.pixel_size,
        "rows": SHAPE[0],
        "columns": SHAPE[1],
        "table": list(TABLE),
    }


def drawable_arrays(drawables: Drawables) -> dict[str, np.ndarray]:
    """A world's `Drawables`, apart from where things are."""
    d = drawables
    return {
        "palette": d.palette,
        "sphere_particle": _whole(d.sphere_particle),
        "sphere_radius": d.sphere_radius,
        "sphere_segment": _whole(d.sphere_segment),
        "link_particle": _whole(d.link_particle),
        "link_radius": d.link_radius,
        "link_segment": _whole(d.link_segment),
        "triangle_particle": _whole(d.triangle_particle),
        "triangle_segment": _whole(d.triangle_segment),
        "box_body": _whole(d.box_body),
        "box_pose": d.box_pose,
        "box_half": d.box_half,
        "box_segment": _whole(d.box_segment),
        "quad_corners": d.quad_corners,
        "quad_segment": _whole(d.quad_segment),
    }


def _whole(numbers: np.ndarray) -> np.ndarray:
    return numbers.astype(np.uint32)


def arm_arrays(robot: Robot) -> tuple[dict[str, np.ndarray], list[dict[str, Any]]]:
    """The arm's meshes, one after the other, and of each its length and colour."""
    meshes = robot.meshes()
    names = list(dict.fromkeys(link for link, _, _ in meshes))
    arrays = {
        "arm_vertices": np.concatenate([np.asarray(m.vertices, np.float32) for _, _, m in meshes]),
        "arm_faces": np.concatenate([np.asarray(m.faces, np.uint32) for _, _, m in meshes]),
    }
    parts = [
        {
            "vertices": len(mesh.vertices),
            "faces": len(mesh.faces),
            "color": list(BLUE if link == "tip" else LINK_COLORS[names.index(link) % 2]),
        }
        for link, _, mesh in meshes
    ]
    return arrays, parts


def link_matrices(robot: Robot, q: np.ndarray) -> np.ndarray:
    """world_T_mesh (T, M, 4, 4) float32 of the arm's meshes at joint positions (T, dof) [rad]."""
    poses: Mapping[str, np.ndarray] = robot.link_poses(q)
    return np.stack(
        [poses[link] @ link_T_mesh for link, link_T_mesh, _ in robot.meshes()], axis=1
    ).astype(np.float32)


def clip(
    robot: Robot, report: StepReport, waiting: np.ndarray, end: Snapshot
) -> tuple[dict[str, np.ndarray], float] | None:
    """The motion of one action, `FRAMES_A_SECOND`, and how long it lasts [s].

    Frames from the first on that is not finite are left out. None where nothing moved.

    Args:
        waiting: joint positions (dof,) [rad] before the action
        end: the state after it, which the last frame shows
    """
    frames, arm = report.frames, ArmPath(report, waiting)
    if frames is None or not len(frames.times):
        return None
    last = max(arm.seconds, float(frames.times[-1]))
    times = np.arange(0.0, last + 1.0 / FRAMES_A_SECOND, 1.0 / FRAMES_A_SECOND)
    shown = np.clip(np.searchsorted(frames.times, times), 0, len(frames.times) - 1)
    particle_q = np.asarray(frames.particle_q, np.float32)[shown]
    body_q = np.asarray(frames.body_q, np.float32)[shown]
    particle_q[-1], body_q[-1] = end.particle_q, end.body_q
    whole = np.array(
        [
            np.isfinite(q).all() and np.isfinite(b).all()
            for q, b in zip(particle_q, body_q, strict=True)
        ]
    )
    count = len(whole) if whole.all() else int(np.argmin(whole))
    if count == 0:
        return None
    arrays = {
        "q": particle_q[:count],
        "body": body_q[:count],
        "links": link_matrices(robot, arm.at(times[:count])),
    }
    return arrays, float(times[count - 1])


def heat_picture(probabilities: np.ndarray) -> np.ndarray:
    """PNG, as bytes, of the square root of probabilities (H, W) over their largest."""
    share = np.sqrt(probabilities / max(float(probabilities.max()), 1e-30))
    return _png(np.rint(255 * share).astype(np.uint8))
