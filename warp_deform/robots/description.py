"""What tells one arm from another: description file, tip, home posture, reach, meshes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

__all__ = ["ArmConfig", "Cylinder", "LinkMesh", "two_link"]


@dataclass(frozen=True)
class LinkMesh:
    """A mesh file drawn with a link, at `xyz` [m] and turned by `yaw` [rad] about the link's z."""

    link: str
    file: str
    xyz: tuple[float, float, float] = (0.0, 0.0, 0.0)
    yaw: float = 0.0


@dataclass(frozen=True)
class Cylinder:
    """A cylinder of `radius` drawn with a link, along its z axis from `start` to `end` [m]."""

    link: str
    radius: float
    start: float
    end: float


@dataclass(frozen=True)
class ArmConfig:
    """What tells one arm from another.

    Attributes:
        name: what users call it
        urdf: the description, a file under assets/
        root, flange: first and last link of the chain
        tip_offset: distance of the tip along the flange's z axis [m]
        mount_yaw: how the root link is turned on the base, about z [rad]
        home_q: joint positions of the home posture [rad]
        posture: tip-down poses (N, 4) to joint positions (N, dof), in closed form; the start of
            the iteration. Its last joint alone depends on yaw, as a constant minus yaw
        reach_table: rows of height, smallest and largest radius [m] of the tip-down reach
        meshes, cylinders: what the arm looks like
    """

    name: str
    urdf: str
    root: str
    flange: str
    tip_offset: float
    mount_yaw: float
    home_q: tuple[float, ...]
    posture: Callable[[np.ndarray], np.ndarray]
    reach_table: tuple[tuple[float, float, float], ...]
    meshes: tuple[LinkMesh, ...]
    cylinders: tuple[Cylinder, ...] = ()


def two_link(
    radius: np.ndarray, height: np.ndarray, upper: float, lower: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the lift of the upper link above the horizontal and the elbow's bend down [rad].

    A planar arm of two links [m] whose end is at `radius`, `height` [m] from the shoulder, elbow
    up. Out of reach it is stretched or folded towards the point.

    Source: Craig, Introduction to Robotics, section 4.4.
    """
    distance2 = radius * radius + height * height
    distance = np.sqrt(distance2)
    bend = np.arccos(np.clip((distance2 - upper**2 - lower**2) / (2.0 * upper * lower), -1.0, 1.0))
    inner = (upper**2 + distance2 - lower**2) / (2.0 * upper * np.maximum(distance, 1e-9))
    return np.arctan2(height, radius) + np.arccos(np.clip(inner, -1.0, 1.0)), bend
