"""The verbs of `warp-deform franka calibrate`, which measure the setup: one a step.

    warp-deform franka calibrate board

Each reads its own flags, and what is heavy is loaded when it measures.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import arg, subcommand

from warp_deform.command.main import CommandOptions, Outcome
from warp_deform.support.flag_range import FlagRange

from ..rig.config import BackendName, CameraName, HomeFlag, RigConfig, SetupFlag, WorkspaceFlag

if TYPE_CHECKING:
    from ..calibration.charuco import BoardSpec

__all__ = ["CALIBRATE", "CalibrateOptions"]

_Views = Annotated[int, arg(metavar="N"), FlagRange(8, 500)]


@dataclass(frozen=True, kw_only=True)
class _SetupFlags(CommandOptions):
    setup: SetupFlag = field(default_factory=lambda: Path("franka-setup"))
    """Folder of the setup, where the results are kept."""


@dataclass(frozen=True, kw_only=True)
class _BoardFlags(_SetupFlags):
    square_mm: Annotated[float, FlagRange(5.0, 500.0)] = 36.0
    """Side of the squares of the printed board [mm]. Measure the print."""

    @property
    def board(self) -> BoardSpec:
        """The board as it is printed."""
        from ..calibration.charuco import BoardSpec

        square = self.square_mm / 1e3
        return BoardSpec(square_m=square, marker_m=square * 26.0 / 36.0)


@dataclass(frozen=True, kw_only=True)
class _CameraFlags(_SetupFlags):
    camera: CameraName = "uvc"
    """The camera."""
    device: str | None = None
    """Number of a video device, or serial number of a RealSense."""


@dataclass(frozen=True, kw_only=True)
class _PlaceFlags(_SetupFlags):
    robot: BackendName = "dry_run"
    """The robot: panda, fr3 or frankapy."""
    host: str | None = None
    """Address of the robot."""
    home: HomeFlag = None
    """Joint positions [rad] of the home pose, from which pictures are taken. The default is what
    --setup has stored, or else the vendor's. They are stored with what is measured."""
    workspace: WorkspaceFlag = None
    """Limits of the workspace along x and y [m]. The default is what --setup has stored, or else
    0.335 0.635 -0.3 0.3. They are stored with what is measured."""


@dataclass(frozen=True, kw_only=True)
class _ArmFlags(_PlaceFlags):
    execute: bool = False
    """Let the arm move. Without this flag nothing moves, and nothing is measured."""


@dataclass(frozen=True, kw_only=True)
class BoardOptions(_BoardFlags):
    """Write the ChArUco board to print.

    Print it at 254 dots an inch, measure a square, and give its side to the other steps.
    """


@dataclass(frozen=True, kw_only=True)
class LensOptions(_BoardFlags, _CameraFlags):
    """Measure the intrinsics of a video device with the board.

    The views are kept if you stop, and the same command continues with them.
    """

    views: _Views = 15
    """Number of views of the board."""
    size: Annotated[tuple[int, int], FlagRange(16, 8192)] = (1280, 720)
    """Width and height of the video device's pictures."""


@dataclass(frozen=True, kw_only=True)
class TableOptions(_ArmFlags):
    """Measure the table: the arm moves and touches the foam at five points, with closed fingers."""

    table_z: Annotated[float | None, arg(metavar="M"), FlagRange(-1.0, 1.0)] = None
    """A height in the base frame that is certainly 1 to 3 cm below the foam's top. Required."""


@dataclass(frozen=True, kw_only=True)
class CameraOptions(_BoardFlags, _CameraFlags, _ArmFlags):
    """Locate the camera with the board flat on the table: you guide the fingertips onto corners.

    One of camera, points and hand is enough.
    """

    corners: Annotated[tuple[int, ...], FlagRange(0, 23)] = (0, 5, 18, 23)
    """Numbers of the board's corners that you touch."""


@dataclass(frozen=True, kw_only=True)
class PointsOptions(_CameraFlags, _ArmFlags):
    """Locate the camera without a board: you click marks on the foam and touch them.

    One of camera, points and hand is enough. The points are kept if you stop, and the same command
    continues with them.
    """

    points: Annotated[int, arg(metavar="N"), FlagRange(5, 500)] = 9
    """Number of marks to touch, at least 5."""
    typed: bool = False
    """Type each mark's column and row instead of clicking it."""
    pairs: Annotated[Path | None, arg(metavar="FILE.csv")] = None
    """Read the points from this file, and move nothing. A line has column, row [px], x, y [m]."""


@dataclass(frozen=True, kw_only=True)
class HandOptions(_BoardFlags, _CameraFlags, _ArmFlags):
    """Locate a camera on the hand: it sees the board from many sides, to which you guide the hand.

    One of camera, points and hand is enough. The views are kept if you stop, and the same command
    continues with them.
    """

    views: _Views = 15
    """Number of views of the board."""


@dataclass(frozen=True, kw_only=True)
class EmptyOptions(_CameraFlags, _PlaceFlags):
    """Take a picture of the empty foam from home, for better masks; moves nothing."""


CalibrateOptions = (
    Annotated[BoardOptions, subcommand("board")]
    | Annotated[LensOptions, subcommand("lens")]
    | Annotated[TableOptions, subcommand("table")]
    | Annotated[CameraOptions, subcommand("camera")]
    | Annotated[PointsOptions, subcommand("points")]
    | Annotated[HandOptions, subcommand("hand")]
    | Annotated[EmptyOptions, subcommand("empty")]
)


def _board(options: BoardOptions) -> Outcome:
    from ..measuring.with_board import print_board

    return _outcome(print_board(options.setup, options.board))


def _lens(options: LensOptions) -> Outcome:
    from ..measuring.with_board import measure_lens

    rig = options.configure(RigConfig)
    return _outcome(measure_lens(rig, options.board, views=options.views, size=options.size))


def _table(options: TableOptions) -> Outcome:
    from ..measuring.with_board import measure_table

    return _outcome(measure_table(options.configure(RigConfig), provisional_z=options.table_z))


def _camera(options: CameraOptions) -> Outcome:
    from ..measuring.with_board import measure_camera

    rig = options.configure(RigConfig)
    return _outcome(measure_camera(rig, options.board, corner_ids=options.corners))


def _points(options: PointsOptions) -> Outcome:
    from ..measuring.with_points import measure_points, points_from_file, type_point

    rig = options.configure(RigConfig)
    if options.pairs is not None:
        return _outcome(points_from_file(rig, options.pairs))
    show = type_point if options.typed else None
    return _outcome(measure_points(rig, points=options.points, show=show))


def _hand(options: HandOptions) -> Outcome:
    from ..measuring.with_board import measure_hand_eye

    rig = options.configure(RigConfig)
    return _outcome(measure_hand_eye(rig, options.board, views=options.views))


def _empty(options: EmptyOptions) -> Outcome:
    from ..measuring.with_board import photograph_empty

    return _outcome(photograph_empty(options.configure(RigConfig)))


def _outcome(data: Mapping[str, Any]) -> Outcome:
    """What was measured, and as text what of it fits on a line each."""
    figures = {key: value for key, value in data.items() if not isinstance(value, list)}
    return Outcome(data=data, text="\n".join(f"{key}  {value}" for key, value in figures.items()))


CALIBRATE: dict[type, Callable[[Any], Outcome]] = {
    BoardOptions: _board,
    LensOptions: _lens,
    TableOptions: _table,
    CameraOptions: _camera,
    PointsOptions: _points,
    HandOptions: _hand,
    EmptyOptions: _empty,
}
"""By the options of a step, what it does."""
