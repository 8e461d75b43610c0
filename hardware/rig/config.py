"""Which robot, camera and agent, by the names of the command line; importing this is quick."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

__all__ = ["REAL_ROBOTS", "AgentName", "CameraName", "RigConfig", "RobotName"]

RobotName = Literal["dry_run", "sim", "panda", "fr3", "frankapy"]
CameraName = Literal["sim", "file", "uvc", "realsense", "azure-kinect"]
AgentName = Literal["planner", "policy", "scripted", "random", "human", "typed"]

REAL_ROBOTS: tuple[RobotName, ...] = ("panda", "fr3", "frankapy")
"""Those that are outside of this process."""


@dataclass(frozen=True, kw_only=True)
class RigConfig:
    """What to open."""

    robot: RobotName = "dry_run"
    """The backend."""
    camera: CameraName = "sim"
    """Where pictures come from."""
    host: str | None = None
    """Address of the robot."""
    setup: Path = field(default_factory=lambda: Path("franka-setup"))
    """Folder of the calibration."""
    frames: Path | None = None
    """Folder of recorded pictures, for the camera "file"."""
    device: str | None = None
    """Number of a video device or serial number of a RealSense."""
    seed: int = 0
    """Of the simulated toss and goal, and of draws."""
    execute: bool = False
    """Whether a real robot moves; without it its commands are printed."""
    joint_speed: float = 0.05
    """Share of the joints' greatest speeds, between poses."""
    home: tuple[float, ...] | None = None
    """Seven joint positions of the home pose [rad]; None: as stored, see `rig.workplace`."""
    workspace: tuple[float, float, float, float] | None = None
    """Ends of the workspace along x, then y [m]; None: as stored."""

    @property
    def moves(self) -> bool:
        """Whether anything moves, if only in simulation."""
        return self.robot == "sim" or (self.robot in REAL_ROBOTS and self.execute)

    @property
    def real(self) -> bool:
        """Whether something outside of this process moves."""
        return self.robot in REAL_ROBOTS and self.execute

    @property
    def robot_id(self) -> str:
        """Which robot, as a calibration names it."""
        host = self.host if self.robot in REAL_ROBOTS else None
        return f"{self.robot} {host or ''}".strip()

    @property
    def camera_id(self) -> str:
        """Which camera, as a calibration names it; no number means device 0."""
        return f"{self.camera} {'' if self.device in (None, '0') else self.device}".strip()
