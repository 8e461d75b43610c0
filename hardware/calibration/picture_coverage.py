"""Whether the camera sees the whole workspace from home; where it does not, what would cure it.

A calibration's homography and the camera's intrinsics tell where the camera is, and so what it
would see from another home pose: with the hand tilted about its TCP, or raised.

Source: the pose of a plane from its homography, Zhang, "A flexible new technique for camera
calibration", 2000, section 3.1.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from warp_deform.errors import InputError

from ..arm.limits import SafetyLimits
from ..arm.panda import PandaKinematics
from ..arm.robot import UnreachablePose
from ..arm.straight_line import straight_line
from .calibration import Calibration
from .reach import check_workplace
from .workplace import Workplace

__all__ = ["camera_pose", "check_picture", "outside"]

_SIDE = 41  # points of the workspace along x, twice as many along y
_MARGIN_PX = 5.0  # that a cured picture keeps around the workspace
_RISE = 0.01  # [m]
_MOST_TRIED = 30


def check_picture(calibration: Calibration, limits: SafetyLimits) -> None:
    """Refuse a calibration whose pictures do not show the whole workspace.

    Raises:
        InputError: how much is outside, which corner by how many pixels, and which home pose would
            show all of it
    """
    share, corner, pixels = outside(calibration)
    if share == 0.0 and pixels <= 0.0:
        return
    cures = []
    for words, home_q in _cures(calibration, limits):
        text = replace(calibration.workplace, home_q=home_q).home_text()
        cures.append(f"{words}: {text}")
    advice = ", or ".join(cures) or "no tilt or height of the hand shows all: a wider lens"
    raise InputError(
        f"{100 * share:.0f} % of the workspace is outside of the camera's picture, its corner "
        f"({corner[0]:.3f}, {corner[1]:.3f}) m by {pixels:.0f} px; {advice}; or give a smaller "
        "--workspace"
    )


def outside(calibration: Calibration) -> tuple[float, tuple[float, float], float]:
    """Return the share of the workspace outside of the picture, the worst corner, and its pixels.

    Pixels are how far that corner is beyond the picture's rim; 0 or less: within.
    """
    xy = _points(calibration.workplace)
    beyond = _beyond(calibration.base_to_pixel(xy), calibration.intrinsics.size)
    corners = np.array([(x, y) for x in calibration.workplace.x for y in calibration.workplace.y])
    off = _beyond(calibration.base_to_pixel(corners), calibration.intrinsics.size)
    worst = int(np.argmax(off))
    corner = float(corners[worst, 0]), float(corners[worst, 1])
    return float((beyond > 0.0).mean()), corner, float(off[worst])


def camera_pose(calibration: Calibration) -> np.ndarray:
    """Return base_T_camera (4, 4) [m] of a calibration, from its homography."""
    table = calibration.table
    H = np.linalg.inv(calibration.base_H_pixel)
    columns = np.linalg.inv(calibration.intrinsics.matrix) @ H  # of (x, y, 1) on the table
    # x and y of the table as directions in space, whose lengths tell the scale
    ex = np.array([1.0, 0.0, table.slope_x])
    ey = np.array([0.0, 1.0, table.slope_y])
    scale = np.linalg.norm(columns[:, :2]) / math.hypot(np.linalg.norm(ex), np.linalg.norm(ey))
    centre = [np.mean(calibration.workplace.x), np.mean(calibration.workplace.y), 1.0]
    columns = columns / math.copysign(float(scale), float(columns[2] @ centre))
    normal = np.cross(ex, ey)
    directions = np.column_stack(
        [columns[:, 0], columns[:, 1], np.cross(columns[:, 0], columns[:, 1])]
    )
    u, _, v = np.linalg.svd(directions @ np.linalg.inv(np.column_stack([ex, ey, normal])))
    camera_R_base = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
    pose = np.eye(4)
    pose[:3, :3] = camera_R_base.T
    origin = np.array([0.0, 0.0, table.height_m])  # where (0, 0, 1) is
    pose[:3, 3] = origin - camera_R_base.T @ columns[:, 2]
    return pose


def _cures(
    calibration: Calibration, limits: SafetyLimits
) -> Iterator[tuple[str, tuple[float, ...]]]:
    """The least tilt and the least rise that show all of the workspace, and their home poses."""
    home = PandaKinematics().pose(calibration.home_q)
    tcp_T_camera = np.linalg.inv(home) @ camera_pose(calibration)
    most = math.floor(math.degrees(limits.max_tilt_rad)) - 1
    degrees = [(a, b) for a in range(-most, most + 1) for b in range(-most, most + 1)]
    tilts = sorted((t for t in degrees if 0 < math.hypot(*t) <= most), key=lambda t: math.hypot(*t))
    tilted = (
        (f"tilt the hand there by {math.hypot(*t):.0f} degrees", _tilted(home, *t)) for t in tilts
    )
    rises = np.arange(_RISE, limits.max_z_m - home[2, 3], _RISE)
    raised = ((f"raise it by {100 * rise:.0f} cm", _raised(home, rise)) for rise in rises)
    for ways in (tilted, raised):
        # The least come first: what is greater than one that the arm can take is not looked at.
        showing = (way for way in ways if _shows(calibration, way[1] @ tcp_T_camera))
        for words, pose in itertools.islice(showing, _MOST_TRIED):
            home_q = _joints(calibration.workplace, pose, limits)
            if home_q is not None:
                yield words, home_q
                break


def _shows(calibration: Calibration, base_T_camera: np.ndarray) -> bool:
    """Whether a camera there has all of the workspace in its picture."""
    xy = _rim(calibration.workplace)
    points = np.column_stack([xy, calibration.table.z(xy)])
    camera_T_base = np.linalg.inv(base_T_camera)
    in_camera = points @ camera_T_base[:3, :3].T + camera_T_base[:3, 3]
    if in_camera[:, 2].min() <= 0.0:
        return False
    straight = in_camera @ calibration.intrinsics.matrix.T
    pixels = calibration.intrinsics.distort(straight[:, :2] / straight[:, 2:])
    return bool(_beyond(pixels, calibration.intrinsics.size).max() <= -_MARGIN_PX)


def _joints(
    workplace: Workplace, pose: np.ndarray, limits: SafetyLimits
) -> tuple[float, ...] | None:
    """Joint positions of a home pose; None where the arm may not stand there."""
    try:
        line = straight_line(PandaKinematics(), np.array(workplace.home_q), pose, speed=0.1)
        home_q = tuple((np.round(line.q[-1], 4) + 0.0).tolist())
        check_workplace(replace(workplace, home_q=home_q), limits)
    except (UnreachablePose, InputError):
        return None
    return home_q


def _tilted(home: np.ndarray, along_x: float, along_y: float) -> np.ndarray:
    """The pose (4, 4) turned about its TCP [degrees], about a level axis."""
    axis = np.radians([along_x, along_y, 0.0])
    angle = float(np.linalg.norm(axis))
    x, y, z = axis / angle
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    R = np.eye(3) + math.sin(angle) * K + (1.0 - math.cos(angle)) * K @ K
    pose = home.copy()
    pose[:3, :3] = R @ home[:3, :3]
    return pose


def _raised(home: np.ndarray, rise: float) -> np.ndarray:
    pose = home.copy()
    pose[2, 3] += rise
    return pose


def _points(workplace: Workplace) -> np.ndarray:
    """A grid over the workspace, its corners too, (n, 2) [m]."""
    xs, ys = np.linspace(*workplace.x, _SIDE), np.linspace(*workplace.y, 2 * _SIDE)
    return np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)


def _rim(workplace: Workplace) -> np.ndarray:
    """Points of its four sides, (n, 2) [m]."""
    t = np.linspace(0.0, 1.0, 9)
    (x0, x1), (y0, y1) = workplace.x, workplace.y
    across = [np.column_stack([x0 + t * (x1 - x0), np.full(9, y)]) for y in (y0, y1)]
    along = [np.column_stack([np.full(9, x), y0 + t * (y1 - y0)]) for x in (x0, x1)]
    return np.concatenate([*across, *along])


def _beyond(pixels: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """By how many pixels each of (n, 2) is beyond the picture's rim, (n,); within: 0 or less."""
    width, height = size
    high = np.array([width - 0.5, height - 0.5])
    beyond: np.ndarray = np.maximum(-0.5 - pixels, pixels - high).max(axis=1)
    return beyond
