"""A robot that moves nothing: it checks and records commands, and reports where they would lead.

The default wherever an action is tried out. Its poses are those of the nominal Panda.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arm.arguments import check_joints, check_line, check_range
from ..arm.panda import GRIPPER_MAX_WIDTH, HOME_Q, PandaKinematics
from ..arm.robot import MoveResult, RobotMode, RobotState
from ..arm.stop_latch import StopLatch
from ..arm.straight_line import straight_line
from ..support.closing import Closing

__all__ = ["DryRunConfig", "DryRunRobot", "RecordedCommand"]


@dataclass(frozen=True, kw_only=True)
class DryRunConfig:
    """Where the imagined robot starts and what it would find."""

    q: tuple[float, ...] = HOME_Q
    """Joint positions at the start [rad]."""
    gripper_width_m: float = GRIPPER_MAX_WIDTH
    """Opening of the fingers at the start [m]."""
    object_width_m: float = 0.004
    """Width of what every grasp finds [m]; 0 lets every grasp miss."""


@dataclass(frozen=True)
class RecordedCommand:
    """A command as it was given.

    Attributes:
        name: the method's name
        arguments: its arguments by name
    """

    name: str
    arguments: dict[str, Any]


class DryRunRobot(Closing):
    """A `Robot` that records.

    Args:
        config: start and objects
        on_command: called with every command, to print it, say

    Attributes:
        commands: what was commanded so far, in order
    """

    def __init__(
        self,
        config: DryRunConfig | None = None,
        *,
        on_command: Callable[[RecordedCommand], None] | None = None,
    ) -> None:
        self.config = config or DryRunConfig()
        self.commands: list[RecordedCommand] = []
        self._on_command = on_command
        self._kinematics = PandaKinematics()
        self._q = check_joints(np.array(self.config.q))[0]
        self._width = self.config.gripper_width_m
        self._latch = StopLatch()

    def _record(self, name: str, **arguments: Any) -> None:
        command = RecordedCommand(name, arguments)
        self.commands.append(command)
        if self._on_command is not None:
            self._on_command(command)

    def state(self) -> RobotState:
        """Return where the commands so far would have led; see `Robot.state`."""
        return RobotState(
            q=self._q.copy(),
            base_T_tcp=self._kinematics.pose(self._q),
            force_N=np.zeros(6),
            gripper_width_m=self._width,
            mode=RobotMode.IDLE,
        )

    def move_joints(self, q: np.ndarray, *, speed: float) -> None:
        """Record joint waypoints; see `Robot.move_joints`."""
        points = check_joints(q)
        check_range("speed", speed, low=0.0, high=1.0, unit="of the greatest speed")
        self._latch.check()
        self._record("move_joints", q=points, speed=speed)
        self._q = points[-1].copy()

    def move_linear(
        self, base_T_tcp: np.ndarray, *, speed: float, stop_force_N: float | None = None
    ) -> MoveResult:
        """Plan a straight line as the arm would, and record it; see `Robot.move_linear`."""
        target = check_line(base_T_tcp, speed=speed)
        self._latch.check()
        plan = straight_line(self._kinematics, self._q, target, speed=speed)
        self._record("move_linear", base_T_tcp=target, speed=speed, stop_force_N=stop_force_N)
        self._q = plan.q[-1].copy()
        return MoveResult(self._kinematics.pose(self._q), contact=False)

    def open_gripper(self, width_m: float = GRIPPER_MAX_WIDTH) -> None:
        """Record an opening; see `Robot.open_gripper`."""
        check_range("width_m", width_m, low=0.0, high=GRIPPER_MAX_WIDTH, unit="m")
        self._latch.check()
        self._record("open_gripper", width_m=width_m)
        self._width = width_m

    def grasp(self, *, width_m: float, force_N: float) -> bool:
        """Record a grasp, which finds what the configuration says; see `Robot.grasp`."""
        check_range("width_m", width_m, low=0.0, high=GRIPPER_MAX_WIDTH, unit="m")
        check_range("force_N", force_N, low=0.0, high=70.0, unit="N")
        self._latch.check()
        self._record("grasp", width_m=width_m, force_N=force_N)
        self._width = min(self.config.object_width_m, self._width)
        return self._width > 0.0

    def stop(self) -> None:
        """Record a stop; later motions are refused until `recover`."""
        self._latch.press()
        self._record("stop")

    def recover(self) -> None:
        """Record a recovery; clears a stop."""
        self._latch.release(self._latch.mark())
        self._record("recover")

    def close(self) -> None:
        """There is nothing to close."""
