"""Whoever watches the robot, in an episode or a setup: confirms proposals, clears problems."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np

from warp_deform.errors import WarpDeformError

from ..arm.pick_place import PickPlaceAction
from ..arm.robot import MotionError, ReflexError, SafetyViolation
from ..arm.safe_robot import SafeRobot

__all__ = ["Answer", "Operator", "Proposal", "Unattended", "described", "until_cleared"]

T = TypeVar("T")


class Answer(StrEnum):
    """What an operator says to a proposal."""

    DO = "do"
    SKIP = "skip"
    """Propose another."""
    STOP = "stop"


@dataclass(frozen=True, eq=False)
class Proposal:
    """A motion that waits for the operator: the next action, or the way home.

    Attributes:
        action: the action; None for the way to the home pose
        poses: its waypoints by name [m], (4, 4) each
        overlay: the action drawn on the workspace; None for the way home
        number: of the action, from 1
        picture: file that shows `overlay`; None where there is none
    """

    action: PickPlaceAction | None
    poses: dict[str, np.ndarray]
    overlay: np.ndarray | None
    number: int
    picture: Path | None = None


def described(proposal: Proposal) -> str:
    """A line that says what is proposed."""
    action = proposal.action
    if action is None:
        return "the arm goes to its home pose"
    turn = math.degrees(action.place_yaw - action.pick_yaw)
    heights = ", ".join(f"{name} {T[2, 3]:.3f}" for name, T in proposal.poses.items())
    return (
        f"action {proposal.number}: pick {_xy(action.pick_xy)} at "
        f"{math.degrees(action.pick_yaw):.0f} deg, place {_xy(action.place_xy)} "
        f"turned by {turn:.0f} deg; z [m]: {heights}"
    )


def _xy(xy: tuple[float, float]) -> str:
    return f"({xy[0]:.3f}, {xy[1]:.3f})"


class Operator(Protocol):
    """Whoever watches the robot: a person at a terminal, at a page, or nobody."""

    attends: bool
    """Whether a person answers. What a person has cleared is no recovery without an operator."""

    def confirm(self, proposal: Proposal) -> Answer:
        """Whether what is proposed may go ahead."""
        ...

    def go_on(self, problem: WarpDeformError) -> bool:
        """Whether the cause of a problem is cleared and the episode may go on."""
        ...

    def wait(self, text: str) -> bool:
        """Wait for something to be done by hand; False where the operator stops instead."""
        ...


class Unattended:
    """Nobody watches: all proposals go ahead, and a reflex is recovered from; nothing else is."""

    attends = False

    def confirm(self, proposal: Proposal) -> Answer:
        """Go ahead."""
        return Answer.DO

    def go_on(self, problem: WarpDeformError) -> bool:
        """Only after a reflex."""
        return isinstance(problem, ReflexError)

    def wait(self, text: str) -> bool:
        """Go on: nobody does anything by hand."""
        return True


def until_cleared(
    robot: SafeRobot,
    operator: Operator,
    attempt: Callable[[], T],
    *,
    problem: MotionError | SafetyViolation | None = None,
) -> T:
    """Return `attempt()`, made again after each problem that the operator has cleared.

    The arm is recovered before each further attempt, which may be a problem itself: Enter came
    before the user stop was released.

    Args:
        robot: is recovered
        operator: is asked about each problem
        attempt: what to do with the robot; may be made several times
        problem: one that has come up already

    Raises:
        RobotError: a problem that is not cleared, or none that an operator can clear
    """
    while True:
        if problem is not None and not operator.go_on(problem):
            raise problem
        try:
            if problem is not None:
                robot.recover(confirmed=operator.attends)
            return attempt()
        except (MotionError, SafetyViolation) as error:
            problem = error
