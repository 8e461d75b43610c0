"""The vendor's objects for one Panda, their calls made bounded and their failures typed.

panda-python waits for the answers to a stop, a setting and a recovery with Python's lock held:
while one is open no thread runs, and no limit of ours ends it; libfranka gives up after a minute. A
reading ends after 1 s without a state. So each of those commands is sent only to a robot that has
just been heard. What stays: a robot that falls silent in the milliseconds between, and a recovery,
during which the process stands still for as long as the robot takes.
"""

from __future__ import annotations

import ctypes
import logging
import threading
import time
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from ..arm.panda import DDQ_MAX, DQ_MAX, GRIPPER_MAX_WIDTH
from ..arm.robot import (
    BackendMissing,
    ConnectionFailed,
    ConnectionLost,
    GraspError,
    IncompatibleVersion,
    MotionError,
    RobotError,
)
from ..arm.stop_latch import StopLatch
from ..support.bounded import POLL, run_bounded
from .franka_config import NetworkedConfig
from .libfranka_errors import typed_error

__all__ = ["BUSY", "PandaLink"]

T = TypeVar("T")
# A reading or setting takes milliseconds; libfranka itself gives up after 1 s without a state.
QUICK_TIMEOUT = 5.0  # [s]
# The vendor's planner gives up after 30 s.
PLANNING_TIMEOUT = 35.0  # [s]
# A reading while the vendor plans keeps a motion from starting: for so long the last one is given
# instead [s].
STARTING = 0.3
# libfranka itself takes a robot for gone after 1 s without a state [s].
SILENCE = 2.0
# It then ends its control loop, a second where the robot's machine is off, but up to a minute where
# that only says nothing: a motion is given up after this [s].
GIVEN_UP = 5.0
TICK = 2.5e-3  # [s]
BUSY = "another control or read operation is running"
"""What a refusal says for which another thread is to blame."""


class PandaLink:
    """A connection to a Panda and its hand.

    Attributes:
        host: the robot's address
        latch: pressed by `stop`; no motion begins before it is released
        frames: F_T_EE and EE_T_K as the vendor's model takes them, 16 numbers each

    Raises:
        BackendMissing, IncompatibleVersion, ConnectionFailed: see `PandaRobot`
    """

    def __init__(self, config: NetworkedConfig) -> None:
        try:
            import panda_py
            from panda_py import libfranka
        except ImportError as error:
            raise BackendMissing(f"panda-python cannot be loaded: {error}") from error
        self.host = config.host
        self._timeout = config.connect_timeout_s
        self._gripper_speed = config.gripper_speed
        self._frame = libfranka.Frame.kEndEffector
        # Without a handler the vendor's warnings would go to stderr; an application may add one.
        logging.getLogger("panda").addHandler(logging.NullHandler())
        logging.getLogger("motion").addHandler(logging.NullHandler())
        self._closed = self._lost = False
        self._following = False
        self.latch = StopLatch()
        self._ended = threading.Event()
        self._begun = 0.0
        self._reading = threading.Lock()
        self._panda = self._connect(lambda: panda_py.Panda(self.host))
        # When the robot goes away, the vendor's destructor ends the whole process. So nothing
        # destroys the object until close() has seen that the robot is still there.
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(self._panda))
        self._robot = self._panda.get_robot()
        try:
            self._gripper = self._connect(lambda: libfranka.Gripper(self.host))
            reading = self.read()
        except RobotError:
            self.close()
            raise
        self.frames = [list(reading.F_T_EE), list(reading.EE_T_K)]

    def _connect(self, make: Callable[[], Any]) -> Any:
        timeout = self._timeout
        try:
            return run_bounded(make, timeout_s=timeout)
        except TimeoutError as error:
            raise ConnectionFailed(f"{self.host} gave no answer in {timeout:g} s") from error
        except RuntimeError as error:
            if "version" in str(error).lower():
                raise IncompatibleVersion(str(error)) from error
            raise ConnectionFailed(f"{self.host}: {error}") from error

    def pose(self, q: np.ndarray) -> np.ndarray:
        """Return base_T_tcp (4, 4) [m] of joint positions [rad] (7,), by the robot's own model."""
        flat = self._panda.get_model().pose(self._frame, list(q), *self.frames)
        return np.array(flat).reshape(4, 4).T

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        """Return the TCP's Jacobian in the base frame (6, 7), by the robot's own model."""
        flat = self._panda.get_model().zero_jacobian(self._frame, list(q), *self.frames)
        return np.array(flat).reshape(7, 6).T

    def read(self) -> Any:
        """Return a libfranka state that the robot sent after this call, or the motion's latest.

        Raises:
            ConnectionLost: none came in a second
        """
        with self._reading:
            if not self._following:
                return self._fresh()
            if time.monotonic() - self._begun < STARTING or not self._panda.is_moving():
                return self._latest
        return self._quick(lambda: self._panda.get_state())

    def _fresh(self) -> Any:
        # The first may have waited in a buffer since nobody read; the second is fresh.
        self._quick(lambda: self._robot.read_once())
        self._latest = self._quick(lambda: self._robot.read_once())
        return self._latest

    def command(self, call: Callable[[Any], T], *, timeout_s: float = QUICK_TIMEOUT) -> T:
        """Return `call(robot)`, a libfranka command, sent to a robot that has just been heard.

        Raises:
            ConnectionLost: the robot is silent
            RobotError: whatever it answers
        """
        self._hear()
        return self._quick(lambda: call(self._robot), timeout_s=timeout_s)

    def _hear(self) -> None:
        """Return once a state has come, also in the middle of a motion."""
        until = time.monotonic() + SILENCE
        while time.monotonic() < until:
            # Twice: the first may have waited in a buffer, as in `_fresh`.
            if self._following and self._ticks() and self._ticks():
                return
            try:
                with self._reading:
                    self._fresh()
                return
            except MotionError as error:  # a motion runs: it ticks, or ends for want of states
                if BUSY not in str(error):
                    raise
        raise self._gone()

    def _gone(self) -> ConnectionLost:
        self._lost = True
        return ConnectionLost(f"{self.host}: the robot sends no states any more")

    def _ticks(self) -> bool:
        """Whether the motion in progress gets states."""
        before = self._tick()
        time.sleep(TICK)
        return self._tick() not in (None, before)

    def _quick(self, call: Callable[[], T], *, timeout_s: float = QUICK_TIMEOUT) -> T:
        """Make a call that takes milliseconds, or as long as is said."""
        if self._closed:
            raise ConnectionLost("this connection was closed", advice="connect anew")
        if self._lost:
            raise self._gone()
        try:
            return run_bounded(call, timeout_s=timeout_s)
        except TimeoutError as error:
            raise ConnectionLost(f"{self.host}: {error}") from error
        except RuntimeError as error:
            raise typed_error(str(error), host=self.host) from _bare(error)

    # Motions.

    def follow(self, start: np.ndarray, points: np.ndarray, factor: float) -> None:
        """Go from `start` (7,) through `points` (N, 7) [rad] at a share of the greatest speeds.

        Raises:
            RobotError: the motion did not get to its end
        """
        steps = np.abs(np.diff(np.vstack([start, points]), axis=0))
        # Each step at its speed, and a start and a stop for each: no trajectory takes longer.
        longest = (steps / (factor * DQ_MAX)).max(axis=1) + (DQ_MAX / DDQ_MAX).max()
        columns = [point.reshape(7, 1) for point in points]
        clock = time.monotonic()
        self._forget_error()
        with self._reading:  # a reading in another thread would make the vendor refuse the motion
            self._following, self._begun = True, time.monotonic()
            self._ended.clear()

        def move() -> bool:
            try:
                return bool(self._panda.move_to_joint_position(columns, speed_factor=factor))
            finally:
                self._ended.set()

        try:
            # Here a stop that came too early to see the motion under way is seen.
            self.latch.check()
            ok = run_bounded(
                move,
                timeout_s=2.0 * float(longest.sum()) + PLANNING_TIMEOUT,
                stop=self._halt,
                watch=self._watch(),
            )
            # A motion that fails says so only here: the vendor keeps the error for later.
            self._panda.raise_error()
        except TimeoutError as error:
            raise MotionError("the motion did not end in time and was stopped") from error
        except RuntimeError as error:
            raise typed_error(str(error), host=self.host) from _bare(error)
        finally:
            self._following = False
        if not ok:
            took = time.monotonic() - clock
            raise MotionError(f"the motion ended after {took:.1f} s, before its last waypoint")

    def _watch(self) -> Callable[[], None]:
        """Return what raises ConnectionLost once states of a motion that has begun stay away."""
        first, last, came = self._tick(), None, 0.0

        def watch() -> None:
            nonlocal last, came
            tick = self._tick()
            if tick not in (None, first, last):
                last, came = tick, time.monotonic()
            elif last is not None and time.monotonic() - came > GIVEN_UP:
                raise self._gone()

        return watch

    def _tick(self) -> float | None:
        """The robot's clock at the motion's latest state [s]; None where the vendor has none yet.

        It would read the robot then, which keeps a motion from starting.
        """
        if not self._panda.is_moving():
            return None
        try:
            return float(self._panda.get_state().time.to_sec())
        except RuntimeError:  # the motion ended just now, and the reading failed: no tick
            return None

    def _forget_error(self) -> None:
        """Drop the error of a motion that was interrupted: the vendor keeps it for the next."""
        try:
            self._panda.raise_error()
        except RuntimeError as error:
            logging.getLogger(__name__).info("an earlier motion ended with: %s", error)

    def stop(self) -> None:
        """End the motion in progress, if any, and let none begin; from any thread.

        Raises:
            ConnectionLost: the robot is silent
        """
        self.latch.press()
        until = time.monotonic() + PLANNING_TIMEOUT
        self.command(lambda robot: robot.stop())
        # While the vendor still plans a motion a stop does nothing, and then the arm would set out.
        while self._following and not self._ended.wait(POLL) and time.monotonic() < until:
            self.command(lambda robot: robot.stop())

    def _halt(self) -> None:
        """Stop a motion that runs in another thread, as well as that can be done."""
        try:
            self.stop()
        except RobotError as error:
            logging.getLogger(__name__).warning("stopping the motion failed: %s", error)

    # The hand, whose commands leave Python's lock alone.

    def width(self) -> float:
        """Return the opening between the fingers [m]."""
        return float(self._quick(lambda: self._gripper.read_once()).width)

    def finger(self, call: Callable[[Any], bool]) -> bool:
        """Return `call(gripper)`, which moves the fingers: whether the hand calls it a success.

        Raises:
            GraspError: it failed, or took too long
            MotionError: `stop` holds
            ConnectionLost: the hand is silent
        """
        self.width()
        self.latch.check()
        # Homing goes there and back at the hand's own pace.
        timeout = 4.0 * GRIPPER_MAX_WIDTH / min(self._gripper_speed, 0.05) + QUICK_TIMEOUT
        try:
            return run_bounded(
                lambda: call(self._gripper), timeout_s=timeout, stop=self._halt_fingers
            )
        except TimeoutError as error:
            self.width()
            raise GraspError("the fingers did not stop in time") from error
        except RuntimeError as error:
            lost = typed_error(str(error), host=self.host)
            raise lost if isinstance(lost, ConnectionLost) else GraspError(str(error)) from _bare(
                error
            )

    def _halt_fingers(self) -> None:
        try:
            self.width()
            self._quick(lambda: self._gripper.stop())
        except RobotError as error:
            logging.getLogger(__name__).warning("stopping the fingers failed: %s", error)

    def close(self) -> None:
        """End the connection; moves nothing, and may be called twice."""
        if self._closed:
            return
        self._closed = True
        if self._lost:
            return  # as below; its control loop may still hang
        try:
            run_bounded(self._panda.stop_controller, timeout_s=QUICK_TIMEOUT)
            for _ in range(2):  # the first may have waited in a buffer
                self._robot.read_once()
        except (RuntimeError, TimeoutError):
            return  # the robot has gone: see __init__
        panda = self._panda
        del self._panda, self._robot
        self._gripper = None
        ctypes.pythonapi.Py_DecRef(ctypes.py_object(panda))


def _bare(error: RuntimeError) -> RuntimeError:
    """Without the frames of the call, which would keep the vendor's objects after close()."""
    return error.with_traceback(None)
