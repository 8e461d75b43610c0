"""What a machine has for a robot, what is missing, and how to get it."""

from __future__ import annotations

import datetime
import importlib.metadata
import importlib.util
import os
import re
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from warp_deform.command.main import CommandOptions, Outcome
from warp_deform.errors import InputError
from warp_deform.support.extras import install_extra

from ..rig.config import NETWORKED_ROBOTS, REAL_ROBOTS, BackendName, SetupFlag

__all__ = ["Check", "DoctorOptions", "doctor", "examine"]

_PACKAGES = (
    ("panda_py", "panda-python", "panda", "Panda, server version 5",
     install_extra("panda")),
    ("franky", "franky-control", "fr3", "FR3 of system 5.9 or later, server version 10",
     install_extra("fr3")),
    ("frankapy", "frankapy", "frankapy", "Panda through ROS and a control PC",
     "install ROS, franka-interface and frankapy from source; panda-python needs none of them"),
    ("pyrealsense2", "pyrealsense2", None, "RealSense cameras",
     f"{install_extra('realsense')}, and libusb-1.0 of the system"),
    ("pyk4a", "pyk4a-bundle", None, "depth of an Azure Kinect; its colour works as --camera uvc",
     "needs numpy 1, so an environment of its own: pip install pyk4a-bundle 'numpy<2'"),
)  # fmt: skip
_OLD_DAYS = 30
_IMPORT_LIMIT = 60.0  # [s]; frankapy reads all of ROS
# As the vendor's own network test: the size of its datagrams, only fewer and slower, so that
# anybody may send them.
_PING = ("ping", "-n", "-q", "-c", "20", "-i", "0.2", "-W", "1", "-s", "1200")
_PING_LIMIT = 40.0  # [s]
# Of the millisecond that a command may take there and back [ms].
_LONGEST_PING, _MEAN_PING = 1.0, 0.5
_TAKE_PRIORITY = (
    "import os; os.sched_setscheduler(0, os.SCHED_FIFO, "
    "os.sched_param(os.sched_get_priority_max(os.SCHED_FIFO)))"
)


@dataclass(frozen=True, kw_only=True)
class DoctorOptions(CommandOptions):
    """Show what this machine has for a robot, what is missing and how to get it. Moves nothing."""

    robot: BackendName = "sim"
    """Robot that must work for the exit code to be 0. sim needs nothing but this package."""
    host: str | None = None
    """Address of a robot to connect to and read."""
    setup: SetupFlag = field(default_factory=lambda: Path("franka-setup"))
    """Folder of the calibration."""


def doctor(options: DoctorOptions) -> Outcome:
    """Examine the machine."""
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


class Check(NamedTuple):
    """One thing that was looked at; `advice` says what to do where it is not `ok`."""

    name: str
    ok: bool
    needed: bool
    found: str
    advice: str


def examine(robot: BackendName, *, host: str | None, setup: Path) -> list[Check]:
    """Look at packages, kernel, compiler, cameras and setup, and at a robot where `host` names one.

    With a `host` the network is measured for 4 s, and the robot is read. Packages are imported in
    processes of their own.

    Args:
        robot: what is to work; what it needs is marked so
        host: address of the robot; None leaves network and robot alone
        setup: folder of the calibration
    """
    checks = [_simulation()]
    for module, distribution, backend, purpose, advice in _PACKAGES:
        checks.append(_package(module, distribution, purpose, advice, needed=backend == robot))
    networked = robot in NETWORKED_ROBOTS
    checks += [_compiler(), _kernel(needed=networked), _priority(needed=networked), _cameras()]
    checks.append(_calibration(setup, needed=robot in REAL_ROBOTS))
    if host is not None:
        checks += [_network(host), _robot(robot, host)]
    elif networked:
        advice = "name it with --host; it is read and not moved"
        checks.append(Check("robot", False, False, "not asked", advice))
    return checks


def _simulation() -> Check:
    import warp_deform

    found = f"warp-deform {warp_deform.__version__}: `warp-deform franka run --robot sim`"
    return Check("simulation", True, True, found, "")


def _package(module: str, distribution: str, purpose: str, advice: str, *, needed: bool) -> Check:
    if importlib.util.find_spec(module) is None:
        return Check(distribution, False, needed, f"not installed ({purpose})", advice)
    try:
        version = importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        version = "of unknown version"
    # Found is not loaded: a library of the system, or a numpy that fits, may be missing.
    code, _, complaint = _run((sys.executable, "-c", f"import {module}"), _IMPORT_LIMIT)
    if code != 0:
        found = f"{version}, but does not load: {complaint}"
        return Check(distribution, False, needed, found, advice)
    return Check(distribution, True, needed, f"{version} ({purpose})", "")


def _run(command: tuple[str, ...], limit_s: float) -> tuple[int, str, str]:
    """Return exit code, output and the last line of complaint of a command."""
    try:
        process = subprocess.run(
            command, capture_output=True, text=True, timeout=limit_s, stdin=subprocess.DEVNULL
        )
    except subprocess.TimeoutExpired:
        return 1, "", f"no end in {limit_s:g} s"
    except OSError as error:
        return 1, "", str(error.strerror)
    complaint = process.stderr.strip().splitlines() or [f"exit code {process.returncode}"]
    return process.returncode, process.stdout, complaint[-1].strip()


def _network(host: str) -> Check:
    """Answers have to come within the millisecond in which the robot expects its next command."""
    advice = (
        "connect the robot's control box to a network card of its own, by cable, and turn that "
        "card's power saving off; a camera belongs on another"
    )
    _, report, complaint = _run((*_PING, host), _PING_LIMIT)
    lost = re.search(r"(\d+(?:\.\d+)?)% packet loss", report)
    times = re.search(r"= [\d.]+/([\d.]+)/([\d.]+)(?:/[\d.]+)? ms", report)
    if lost is None:
        missing = "see whether the name is right, and install ping (apt install iputils-ping)"
        return Check("network", False, False, f"not measured: {complaint}", missing)
    if times is None:
        return Check("network", False, False, f"{host}: {lost[1]} % lost", advice)
    mean, longest = float(times[1]), float(times[2])
    found = f"{host}: {mean:.2f} ms there and back, {longest:.2f} ms at most, {lost[1]} % lost"
    ok = float(lost[1]) == 0.0 and mean <= _MEAN_PING and longest <= _LONGEST_PING
    return Check("network", ok, False, found, advice)


def _priority(*, needed: bool) -> Check:
    """Whether a process may have real-time priority, which the vendor's control loop asks for."""
    code, _, complaint = _run((sys.executable, "-c", _TAKE_PRIORITY), _IMPORT_LIMIT)
    found = "may be had" if code == 0 else f"refused: {complaint}"
    advice = (
        "without it a busy machine stops the arm; as root put `USER - rtprio 99` into "
        "/etc/security/limits.d/99-realtime.conf, with your name for USER, and log in again"
    )
    return Check("real-time priority", code == 0 or not needed, False, found, advice)


def _compiler() -> Check:
    from ..emulator.model_library import find_compiler

    path = find_compiler()
    advice = "install one (apt install gcc); only `franka emulate` needs it"
    return Check("C compiler", path is not None, False, path or "none", advice)


def _kernel(*, needed: bool) -> Check:
    """A real-time kernel is not needed to connect, but without it the robot stops now and then."""
    realtime = Path("/sys/kernel/realtime")
    ok = realtime.is_file() and realtime.read_text().strip() == "1"
    found = f"{os.uname().release}, {'PREEMPT_RT' if ok else 'not real-time'}"
    advice = (
        "expect communication_constraints_violation; install a PREEMPT_RT kernel and connect the "
        "robot to a network card of its own"
    )
    return Check("kernel", ok or not needed, False, found, advice)


def _cameras() -> Check:
    devices = sorted(path.name for path in Path("/dev").glob("video*"))
    advice = "plug one in, and join the group `video`; --camera sim needs none"
    return Check("video devices", bool(devices), False, ", ".join(devices) or "none", advice)


def _calibration(setup: Path, *, needed: bool) -> Check:
    from ..calibration.calibration import Calibration

    path = setup / "calibration.json"
    if not path.is_file():
        advice = "calibrate board, lens, table and camera; docs/hardware.md explains the steps"
        return Check("calibration", False, needed, f"no {path}", advice)
    try:
        calibration = Calibration.load(path)
        age = datetime.datetime.now(datetime.UTC) - datetime.datetime.fromisoformat(
            calibration.created
        )
    except (InputError, TypeError, ValueError) as error:
        return Check("calibration", False, needed, str(error), "calibrate anew")
    found = (
        f"{calibration.robot_id}, {calibration.camera_id}: {1e3 * calibration.error_m:.1f} mm by "
        f"{calibration.method}, {age.days} days old"
    )
    return Check("calibration", age.days <= _OLD_DAYS, False, found, "calibrate the camera again")


def _robot(robot: BackendName, host: str) -> Check:
    from ..arm.robot import RobotError
    from ..rig.config import RigConfig
    from ..rig.rig import open_robot

    backend: BackendName = robot if robot in REAL_ROBOTS else "panda"
    config = RigConfig(robot=backend, host=host, execute=True)
    try:
        with open_robot(config) as connected:
            state = connected.state()
    except RobotError as error:
        what = str(error).removesuffix(f"; {error.advice}")
        return Check("robot", False, True, what, error.advice)
    x, y, z = state.base_T_tcp[:3, 3]
    found = f"{host}: {state.mode}, TCP at ({x:.3f}, {y:.3f}, {z:.3f}) m"
    advice = (
        "look at the arm and its lights, release the user stop; a command that moves has it "
        "recover first; what is left takes Desk"
    )
    return Check("robot", str(state.mode) == "idle", True, found, advice)
