"""A robot, a camera and their calibration, opened by the names of the command line."""

from __future__ import annotations

import contextlib
import functools
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import assert_never

import numpy as np

from warp_deform.errors import InputError

from ..arm.robot import Robot
from ..arm.safe_robot import SafeRobot
from ..arm.table_plane import TablePlane
from ..backends.dry_run import DryRunConfig, DryRunRobot, RecordedCommand
from ..backends.franka_config import NetworkedConfig
from ..calibration.calibration import Calibration
from ..calibration.picture_coverage import check_picture
from ..calibration.reach import check_workplace
from ..calibration.workplace import Workplace
from ..cameras.camera import Camera, CameraIntrinsics, FileCamera, read_image
from ..emulator.world import World
from ..support.json_file import read_json, require
from ..twin.twin import TwinConfig, TwinLook
from ..vision.top_down_view import TopDownView
from .config import REAL_ROBOTS, RigConfig

__all__ = [
    "Rig",
    "open_camera",
    "open_rig",
    "open_robot",
    "read_calibration",
    "read_intrinsics",
    "read_table",
]


@dataclass(frozen=True, eq=False)
class Rig:
    """What is open.

    Attributes:
        look: the true state, where the camera is simulated
        toss: tosses the chain again, given how often it was, where it is simulated in this process
        lay: puts its beads, where it is simulated in this process
        empty: the view of the foam without a cable, where the setup has one
    """

    robot: SafeRobot
    camera: Camera
    calibration: Calibration
    view: TopDownView
    look: Callable[[], TwinLook] | None
    toss: Callable[[int], None] | None
    lay: Callable[[np.ndarray], None] | None
    empty: np.ndarray | None


@contextlib.contextmanager
def open_rig(config: RigConfig) -> Iterator[Rig]:
    """Open everything, and close it afterwards; an error inside stops the arm.

    Raises:
        InputError: the choices do not go together, or the setup is missing
        ConnectionFailed, CameraError: robot or camera cannot be opened
    """
    with contextlib.ExitStack() as stack:
        look: Callable[[], TwinLook] | None = None
        toss: Callable[[int], None] | None = None
        lay: Callable[[np.ndarray], None] | None = None
        world: World | None = None
        if config.camera == "sim":
            from ..twin.camera import SimCamera, sim_calibration

            place = Workplace().with_flags(config.home, config.workspace)
            twin = TwinConfig(seed=config.seed, home_q=place.home_q, view=place.view)
            calibration = sim_calibration(twin)
            _check_simulated(calibration)
            if config.robot in REAL_ROBOTS and config.execute:
                host = config.host or "127.0.0.1"
                from ..twin.look_server import remote_look

                look = functools.partial(remote_look, host)
                look()  # before the arm is asked for: nobody there is the commoner mistake
            else:
                from ..twin.twin import CableTwin

                world = chain = CableTwin(twin)
                look, lay = chain.look, chain.lay
                toss = functools.partial(chain.toss, config.seed)
            camera: Camera = SimCamera(look, twin=twin, seed=config.seed)
        else:
            if config.robot == "sim":
                raise InputError("the robot sim needs --camera sim: nothing else sees its chain")
            calibration = read_calibration(config)
            camera = open_camera(config, calibration.intrinsics)
        stack.enter_context(camera)
        empty = config.setup / "empty_view.png"
        has_empty = config.camera != "sim" and empty.is_file()
        picture = read_image(empty, color=True) if has_empty else None
        workplace = calibration.workplace
        limits = workplace.limits(calibration.table, max_joint_speed=config.joint_speed)
        backend = open_robot(config, world=world, home_q=calibration.home_q)
        try:
            robot = SafeRobot(backend, limits, home_q=workplace.home_q)
        except BaseException:
            backend.close()
            raise
        stack.enter_context(robot)
        yield Rig(robot, camera, calibration, workplace.view, look, toss, lay, picture)


def _check_simulated(calibration: Calibration) -> None:
    """Refuse a home pose or workspace that a simulated setup cannot have; say what is not reached.

    Raises:
        InputError: out of reach, or out of the simulated camera's picture
    """
    limits = calibration.workplace.limits(calibration.table)
    warning = check_workplace(calibration.workplace, limits)
    if warning is not None:
        print(warning, file=sys.stderr, flush=True)
    check_picture(calibration, limits)


def open_robot(
    config: RigConfig, *, world: World | None = None, home_q: np.ndarray | None = None
) -> Robot:
    """Connect to a backend; moves nothing.

    Raises:
        InputError: a real robot without an address
        ConnectionFailed: it cannot be reached, or the vendor's package is missing
    """
    name = config.robot
    if name == "sim":
        from ..twin.robot import SimRobot, SimRobotConfig

        if world is None:
            raise InputError("the robot sim needs --camera sim, which brings its chain")
        return SimRobot(
            world, SimRobotConfig() if home_q is None else SimRobotConfig(q=tuple(home_q))
        )
    if name == "dry_run" or not config.execute:
        start = DryRunConfig() if home_q is None else DryRunConfig(q=tuple(home_q))
        return DryRunRobot(start, on_command=_tell)
    if name == "frankapy":
        from ..backends.frankapy import FrankapyRobot

        return FrankapyRobot()
    if config.host is None:
        raise InputError(f"--robot {config.robot} needs --host, the address of its control box")
    if name == "panda":
        from ..backends.panda import PandaRobot

        return PandaRobot(NetworkedConfig(host=config.host))
    if name == "fr3":
        from ..backends.fr3 import FR3Robot

        return FR3Robot(NetworkedConfig(host=config.host))
    assert_never(name)


def _tell(command: RecordedCommand) -> None:
    """Print a dry run's command."""
    words = []
    for name, value in command.arguments.items():
        if name == "base_T_tcp":
            value = "to ({:.3f}, {:.3f}, {:.3f})".format(*value[:3, 3])
        elif name == "q":
            value = f"through {len(value)} waypoints"
        elif value is None:
            continue
        else:
            value = f"{name} {value:g}"
        words.append(value)
    print(f"dry run: {command.name} {', '.join(words)}".rstrip(), file=sys.stderr)


def open_camera(config: RigConfig, intrinsics: CameraIntrinsics | None) -> Camera:
    """Open a camera that is no simulated one.

    Raises:
        InputError: what it needs to know is missing
        CameraError: it cannot be opened
    """
    name = config.camera
    if name == "sim":
        raise InputError(
            "--camera sim is drawn for a simulated arm; name a camera, as --camera uvc"
        )
    if name == "file":
        if config.frames is None or intrinsics is None:
            raise InputError("--camera file needs --frames, and a calibration in --setup")
        if config.real:
            raise InputError(
                "--camera file shows recorded pictures; a robot that moves needs a live camera"
            )
        return FileCamera(config.frames, intrinsics)
    if name == "uvc":
        from ..cameras.uvc import UVCCamera

        if intrinsics is None:
            raise InputError("--camera uvc needs intrinsics: warp-deform franka calibrate lens")
        return UVCCamera(intrinsics, index=_number(config.device))
    if name == "realsense":
        from ..cameras.realsense import RealSenseCamera

        return RealSenseCamera(serial=config.device)
    if name == "azure-kinect":
        from ..cameras.azure_kinect import AzureKinectCamera

        return AzureKinectCamera(device_id=_number(config.device))
    assert_never(name)


def _number(device: str | None) -> int:
    if device is not None and not device.isdigit():
        raise InputError(f"--device is {device!r}; it must be the number of a device, 0 say")
    return int(device or 0)


def read_calibration(config: RigConfig) -> Calibration:
    """Return the setup's calibration, if it is that of the setup as it is now.

    Raises:
        InputError: missing or damaged, the table was touched off anew since, or it is that of
            another robot, camera, home pose or workspace
    """
    calibration = Calibration.load(config.setup / "calibration.json")
    workplace = calibration.workplace
    flags = "leave the flag out, or calibrate camera (or points, or hand) with it"
    stored = Workplace.load(config.setup)
    calibrate_again = "calibrate camera (or points, or hand) again"
    for wanted, advice in (
        (workplace.with_flags(config.home, config.workspace), flags),
        (stored or workplace, calibrate_again),
    ):
        difference = workplace.difference(wanted)
        if difference is not None:
            raise InputError(f"the calibration in {config.setup} is of {difference}; {advice}")
    touched = config.setup / "table.json"
    if touched.is_file() and read_table(touched) != calibration.table:
        raise InputError(
            f"{touched} and the calibration hold different tables, so the safety floor would be "
            f"wrong; {calibrate_again}"
        )
    if config.robot in REAL_ROBOTS:
        pairs = [("robot", "--robot and --host", calibration.robot_id, config.robot_id)]
        if config.camera != "file":
            pairs.append(
                ("camera", "--camera and --device", calibration.camera_id, config.camera_id)
            )
        for what, flags, calibrated, named in pairs:
            if calibrated != named:
                raise InputError(
                    f"the calibration in {config.setup} is of the {what} {calibrated!r}, not "
                    f"{named!r}; give {flags} as you did then, or calibrate again"
                )
    return calibration


def read_table(path: Path) -> TablePlane:
    """Return the plane that `calibrate table` wrote.

    Raises:
        InputError: missing or damaged
    """
    _expect(path, "table")
    record = read_json(path, what="table", schema=1)
    keys = ("height_m", "slope_x", "slope_y")
    return TablePlane(*(float(require(record, k, float, what=f"table {path}")) for k in keys))


def read_intrinsics(path: Path) -> CameraIntrinsics:
    """Return intrinsics that `calibrate lens` wrote.

    Raises:
        InputError: missing or damaged
    """
    _expect(path, "lens")
    record = read_json(path, what="intrinsics", schema=1)
    return CameraIntrinsics.from_record(record, what=f"intrinsics {path}")


def _expect(path: Path, what: str) -> None:
    """Say how to get a measured file that is not there."""
    if not path.is_file():
        raise InputError(f"no {path}: `warp-deform franka calibrate {what}` first")
