"""Which robot, camera and agent, by the names of the command line; importing this is quick."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import arg

from warp_deform.support.flag_range import SEED, FlagRange

__all__ = [
    "CAMERAS_WITHOUT_INTRINSICS",
    "NETWORKED_ROBOTS",
    "REAL_ROBOTS",
    "BackendName",
    "CameraName",
    "ChooserName",
    "HomeFlag",
    "RigConfig",
    "SetupFlag",
    "WorkspaceFlag",
]

BackendName = Literal["dry_run", "sim", "panda", "fr3", "frankapy"]
CameraName = Literal["sim", "file", "uvc", "realsense", "azure-kinect"]
ChooserName = Literal["planner", "policy", "scripted", "random", "human", "typed"]

SetupFlag = Annotated[Path, arg(metavar="DIR")]
HomeFlag = Annotated[
    tuple[float, float, float, float, float, float, float] | None,
    arg(metavar="Q1 ... Q7"),
    FlagRange(-4.0, 4.0),
]
WorkspaceFlag = Annotated[
    tuple[float, float, float, float] | None, arg(metavar="X0 X1 Y0 Y1"), FlagRange(-1.0, 1.0)
]

REAL_ROBOTS: tuple[BackendName, ...] = ("panda", "fr3", "frankapy")
"""Those that are outside of this process."""
NETWORKED_ROBOTS: tuple[BackendName, ...] = ("panda", "fr3")
"""Those of them whose control box is spoken to directly, at `RigConfig.host`."""
CAMERAS_WITHOUT_INTRINSICS: tuple[CameraName, ...] = ("uvc",)
"""Cameras that do not tell their intrinsics: `calibrate lens` measures them."""


@dataclass(frozen=True, kw_only=True)
class RigConfig:
    """Robot, camera and where their calibration is."""

    robot: BackendName = "dry_run"
    """dry_run prints commands and moves nothing. sim moves a simulated chain. panda (panda-python,
    server version 5), fr3 (franky, 10) and frankapy (ROS) move an arm if --execute is given."""
    camera: CameraName = "sim"
    """sim sees the simulated chain, also that of `emulate --chain`. file shows --frames again."""
    host: str | None = None
    """Address of the robot or of the emulator."""
    setup: SetupFlag = field(default_factory=lambda: Path("franka-setup"))
    """Folder of the calibration, as `calibrate` writes it. Not needed with --camera sim."""
    device: str | None = None
    """Number of a video device, or serial number of a RealSense."""
    frames: Annotated[Path | None, arg(metavar="DIR")] = None
    """Folder `frames` of an episode, whose pictures --camera file shows."""
    seed: Annotated[int, SEED] = 0
    """Seed of the simulated toss and goal, and of what an agent draws."""
    execute: bool = False
    """Let a real arm move. Without this flag its commands are only printed."""
    home: HomeFlag = None
    """Joint positions of the home pose [rad]. A setup has them from its calibration, and others are
    refused. With --camera sim they may be any at which the arm can wait."""
    workspace: WorkspaceFlag = None
    """Limits of the workspace along x and y [m], with the same rules as --home."""
    joint_speed: Annotated[float, FlagRange(1e-3, 0.2)] = 0.05
    """Share of the joints' greatest speeds, between poses. At most 0.2; begin with 0.05."""

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
