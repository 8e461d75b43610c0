"""The emulated hand: two fingers that move at a set speed and stop at what is between them."""

from __future__ import annotations

from ..arm.panda import GRIPPER_MAX_WIDTH
from .protocol import GripperCommand, GripperStatus, Request
from .requests import GRIPPER_FORMS, read

__all__ = ["Gripper"]

HOMING_SPEED = 0.05  # [m/s]
# Fingers within this of where they should be have arrived [m].
ARRIVED = 1e-9


class Gripper:
    """Width, grasp and the command in progress.

    A command that is replaced by another, or by a stop, ends as ABORTED. A move onto an object
    ends as UNSUCCESSFUL where the object stops the fingers.

    Attributes:
        width: opening between the fingers [m]
        grasped: whether the last grasp ended within the tolerance of its expected width
        closing: whether the fingers press
    """

    def __init__(self, *, width: float) -> None:
        self.width = width
        self.grasped = False
        self.closing = False
        self._request: Request | None = None
        self._stages: list[float] = []
        self._speed = HOMING_SPEED

    @property
    def busy(self) -> bool:
        """Whether a command is in progress."""
        return self._request is not None

    def start(self, request: Request) -> list[tuple[Request, GripperStatus]]:
        """Begin a command; returns the commands that ended by it.

        One that is refused disturbs nothing.

        Raises:
            ValueError: there is no such command
        """
        values = read(request, GRIPPER_FORMS)
        if values is None:
            return [(request, GripperStatus.FAIL)]
        ended = self.abandon()
        if request.command == GripperCommand.STOP:
            return [*ended, (request, GripperStatus.SUCCESS)]
        self._plan(request, values)
        self._request = request
        self.grasped = False
        self.closing = request.command == GripperCommand.GRASP
        return ended

    def abandon(self) -> list[tuple[Request, GripperStatus]]:
        """Stop the fingers where they are; returns the command that ended by it, if one did."""
        ended = [(self._request, GripperStatus.ABORTED)] if self._request else []
        self._request, self._stages = None, []
        return ended

    def _plan(self, request: Request, values: tuple[float, ...]) -> None:
        if request.command == GripperCommand.HOMING:
            self._stages, self._speed = [0.0, GRIPPER_MAX_WIDTH], HOMING_SPEED
        elif request.command == GripperCommand.MOVE:
            width, self._speed = values
            self._stages = [width]
        else:
            self._grasp = values
            self._stages, self._speed = [0.0], self._grasp[3]

    def step(self, dt: float, object_width: float) -> tuple[Request, GripperStatus] | None:
        """Move the fingers for `dt` [s]; returns the command that ended, if one did."""
        if self._request is None:
            return None
        target = self._stages[0]
        reach = self._speed * dt
        blocked = False
        if target < self.width:
            stop = max(target, min(object_width, self.width))
            self.width = max(self.width - reach, stop)
            blocked = self.width <= stop and stop > target + ARRIVED
        else:
            self.width = min(self.width + reach, target)
        if not blocked and abs(self.width - target) > ARRIVED:
            return None
        self.width = self.width if blocked else target
        return self._arrive(blocked)

    def _arrive(self, blocked: bool) -> tuple[Request, GripperStatus] | None:
        request = self._request
        assert request is not None
        self._stages.pop(0)
        status = GripperStatus.SUCCESS
        if request.command == GripperCommand.GRASP:
            expected, inner, outer = self._grasp[:3]
            # As the real hand judges: with a wide tolerance, closing on nothing counts as a grasp.
            self.grasped = expected - inner < self.width < expected + outer
            if not self.grasped:
                status = GripperStatus.UNSUCCESSFUL
                self.closing = False
        elif self._stages:
            return None  # homing: fingers closed, now open
        elif blocked:
            status = GripperStatus.UNSUCCESSFUL
        self._request = None
        return request, status
