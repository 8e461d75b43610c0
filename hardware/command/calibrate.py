"""The verbs of `warp-deform franka` that look at the machine and measure the setup."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from warp_deform.command.main import CommandOptions, Outcome
from warp_deform.support.flag_range import FlagRange

from ..rig.config import CameraName, RigConfig, RobotName

__all__ = ["CalibrateOptions", "DoctorOptions", "HomeFlag", "WorkspaceFlag", "calibrate", "doctor"]

HomeFlag = Annotated[
    tuple[float, float, float, float, float, float, float] | None,
    arg(metavar="Q1 ... Q7"),
    FlagRange(-4.0, 4.0),
]
WorkspaceFlag = Annotated[
    tuple[float, float, float, float] | None, arg(metavar="X0 X1 Y0 Y1"), FlagRange(-1.0, 1.0)
]


@dataclass(frozen=True, kw_only=True)
class DoctorOptions(CommandOptions):
    """What this machine has for a robot, what is missing, and how to get it; moves nothing."""

    robot: RobotName = "sim"
    """What must work for the exit code to be 0; sim needs nothing but this package."""
    host: str | None = None
    """Address of a robot to connect to and read."""
    setup: Annotated[Path, arg(metavar="DIR")] = field(default_factory=lambda: Path("franka-setup"))
    """Folder of the calibration."""


def doctor(options: DoctorOptions) -> Outcome:
    """Examine the machine."""
    from .doctor import examine

    checks = examine(options.robot, host=options.host, setup=options.setup)
    missing = [check for check in checks if check.needed and not check.ok]
    width = max(len(check.name) for check in checks)
    lines = []
    for check in checks:
        mark = "ok" if check.ok else ("MISSING" if check.needed else "-")
        lines.append(f"{mark:<8}{check.name:<{width}}  {check.found}")
        if not check.ok:
            lines.append(f"{'':<8}{'':<{width}}  {check.advice}")
    data: dict[str, Any] = {
        "ready": not missing,
        "robot": options.robot,
        "checks": [check._asdict() for check in checks],
    }
    first = missing[0] if missing else None
    failure = None if first is None else f"{first.name}: {first.found}; {first.advice}"
    return Outcome(data=data, text="\n".join(lines), failure=failure)


@dataclass(frozen=True, kw_only=True)
class CalibrateOptions(CommandOptions):
    """Measure the setup: board, lens, table, camera, in this order; see docs/hardware.md.

    Everything lands in the setup's folder.
    """

    what: Annotated[
        Positional[Literal["board", "lens", "table", "camera", "points", "hand", "empty"]],
        arg(metavar="WHAT"),
    ]
    """board writes the ChArUco board to print; lens measures a video device's intrinsics with it;
    table touches the foam with the closed fingers; camera finds the board, flat on the table, and
    asks for some of its corners; points does without a board: marks on the foam are clicked and
    touched; hand finds a camera on the hand by looking at the board from many sides; of camera,
    points and hand one is enough; empty takes a picture of the empty foam. What points and hand
    have measured is kept when they are stopped, and gone on from."""
    robot: RobotName = "dry_run"
    """The robot that touches."""
    host: str | None = None
    """Its address."""
    camera: CameraName = "uvc"
    """The camera."""
    device: str | None = None
    """Number of a video device, or serial number of a RealSense."""
    setup: Annotated[Path, arg(metavar="DIR")] = field(default_factory=lambda: Path("franka-setup"))
    """Folder of the setup."""
    home: HomeFlag = None
    """Joint positions [rad] at which pictures are taken; left out, as stored in --setup, at first
    the vendor's and the paper's."""
    workspace: WorkspaceFlag = None
    """Ends of the workspace along x and y [m]; left out, as stored, at first 0.335 0.635 -0.3 0.3.
    Both are stored with the calibration."""
    execute: bool = False
    """Let a real arm move."""
    table_z: Annotated[float | None, arg(metavar="M"), FlagRange(-1.0, 1.0)] = None
    """For `table`: a height in the base frame that is certainly 1 to 3 cm below the foam's top."""
    views: Annotated[int, arg(metavar="N"), FlagRange(8, 500)] = 15
    """For `lens` and `hand`: views of the board."""
    size: Annotated[tuple[int, int], FlagRange(16, 8192)] = (1280, 720)
    """For `lens`: width and height of the video device's pictures."""
    square_mm: Annotated[float, FlagRange(5.0, 500.0)] = 36.0
    """Side of the printed board's squares: measure the print."""
    corners: Annotated[tuple[int, ...], FlagRange(0, 23)] = (0, 5, 18, 23)
    """For `camera`: the board's corners to touch, by number."""
    points: Annotated[int, arg(metavar="N"), FlagRange(5, 500)] = 9
    """For `points`: marks to touch, at least 5."""
    typed: bool = False
    """For `points`: type each mark's column and row instead of clicking it."""
    pairs: Annotated[Path | None, arg(metavar="FILE.csv")] = None
    """For `points`: take them from this file, a line of column, row [px], x, y [m] for each, and
    move nothing."""

    def rig(self) -> RigConfig:
        """What to open."""
        return RigConfig(
            robot=self.robot,
            camera=self.camera,
            host=self.host,
            setup=self.setup,
            device=self.device,
            execute=self.execute,
            home=self.home,
            workspace=self.workspace,
        )


def calibrate(options: CalibrateOptions) -> Outcome:
    """Measure a part of the setup."""
    from ..calibration.charuco import BoardSpec
    from ..measuring import with_board as setting_up
    from ..measuring import with_points as touching_points

    square = options.square_mm / 1e3
    board = BoardSpec(square_m=square, marker_m=square * 26.0 / 36.0)
    rig = options.rig()
    if options.what == "board":
        data = setting_up.print_board(options.setup, board)
    elif options.what == "lens":
        data = setting_up.measure_lens(rig, board, views=options.views, size=options.size)
    elif options.what == "table":
        data = setting_up.measure_table(rig, provisional_z=options.table_z)
    elif options.what == "camera":
        data = setting_up.measure_camera(rig, board, corner_ids=options.corners)
    elif options.what == "points" and options.pairs is not None:
        data = touching_points.points_from_file(rig, options.pairs)
    elif options.what == "points":
        show = touching_points.type_point if options.typed else None
        data = touching_points.measure_points(rig, points=options.points, show=show)
    elif options.what == "hand":
        data = setting_up.measure_hand_eye(rig, board, views=options.views)
    else:
        data = setting_up.photograph_empty(rig)
    said = {key: value for key, value in data.items() if not isinstance(value, list)}
    return Outcome(data=data, text="\n".join(f"{key}  {value}" for key, value in said.items()))
