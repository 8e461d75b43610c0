"""Recording an episode while it runs: append only, on the disk after every step.

A kill or a pulled plug loses the step in flight and nothing else.
`hardware.recordings.recording` reads the folder and says what is in it.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np

from warp_deform.episodes import versions
from warp_deform.errors import InputError
from warp_deform.tasks.metrics import mask_iou

from ..arm.pick_place import PickPlaceAction, PickPlaceResult
from ..arm.robot import Robot, RobotError, RobotState
from ..arm.safe_robot import SafeRobot
from ..cameras.camera import DEPTH_UNIT, Frame
from ..support.closing import Closing
from ..support.json_file import write_json, write_whole
from .recording import SCHEMA

__all__ = ["EpisodeRecorder", "RecorderConfig"]


@dataclass(frozen=True, kw_only=True)
class RecorderConfig:
    """What is known when an episode begins."""

    robot_id: str
    """Which robot."""
    camera_id: str
    """Which camera."""
    actor: str
    """Who acts: "human", or a policy's name."""
    calibration: str
    """`Calibration.digest()`."""
    config: dict[str, Any] = field(default_factory=dict)
    """The episode's configuration, JSON types."""
    note: str = ""
    """The operator's words."""
    revision: str = ""
    """Revision of the software, where it runs from a checkout."""


class EpisodeRecorder(Closing):
    """Writes one episode's folder.

    Args:
        folder: is made; must not exist, or be empty
        config: what is known at the start
        goal_mask: (H, W) bool, what the cable should look like from above; None without a goal
        goal_view: the goal seen from above, (H, W, 3) uint8; default: the mask

    Raises:
        InputError: the folder holds something, or cannot be written
    """

    def __init__(
        self,
        folder: Path,
        config: RecorderConfig,
        *,
        goal_mask: np.ndarray | None = None,
        goal_view: np.ndarray | None = None,
    ) -> None:
        self.folder = folder
        self._goal = goal_mask
        self._observations = self._actions = 0
        self._start = time.monotonic()
        self._writing = threading.Lock()
        self._broken: InputError | None = None
        try:
            (folder / "frames").mkdir(parents=True)
        except FileExistsError as error:
            raise InputError(f"{folder} holds an episode already; choose another folder") from error
        except OSError as error:
            raise InputError(f"{folder} cannot be made: {error.strerror}") from error
        self._meta: dict[str, Any] = {
            "schema": SCHEMA,
            "robot_id": config.robot_id,
            "camera_id": config.camera_id,
            "actor": config.actor,
            "calibration": config.calibration,
            "config": config.config,
            "note": config.note,
            "revision": config.revision,
            "versions": versions(),
            "started_s": time.time(),
            "has_goal": goal_mask is not None,
            "outcome": None,
        }
        if goal_mask is not None:
            self._write_mask(folder / "goal_mask.png", goal_mask)
            triple = np.repeat(np.where(goal_mask, 255, 0).astype(np.uint8)[..., None], 3, axis=2)
            _write_rgb(folder / "goal_view.png", triple if goal_view is None else goal_view)
        # The files of lines exist before episode.json does: a folder that has it can be read.
        self._steps: BinaryIO = (folder / "steps.jsonl").open("xb")
        self._robot: BinaryIO = (folder / "robot.jsonl").open("xb")
        write_json(folder / "episode.json", self._meta)

    def observe(
        self, frame: Frame, view: np.ndarray, mask: np.ndarray, *, overlay: np.ndarray | None = None
    ) -> float | None:
        """Record what is seen, before the first action and after each; returns its overlap.

        Args:
            frame: the camera's picture
            view: the workspace from above, (H, W, 3) uint8
            mask: the cable in it, (H, W) bool
            overlay: a picture for people, (h, w, 3) uint8; `show` replaces it by a proposal
        """
        if self._observations != self._actions:
            raise InputError("an observation follows an action; record the action first")
        if mask.shape != view.shape[:2]:
            raise InputError(f"the mask {mask.shape} and the view {view.shape} differ in size")
        iou = None if self._goal is None else mask_iou(mask, self._goal)
        stem = self.folder / "frames" / f"{self._observations:03d}"
        _write_rgb(_named(stem, "rgb"), frame.rgb)
        _write_rgb(_named(stem, "view"), view)
        self._write_mask(_named(stem, "mask"), mask)
        if frame.depth_m is not None:
            levels = np.rint(np.nan_to_num(frame.depth_m) / DEPTH_UNIT)
            # Farther than 6.5 m counts as unknown, like what the camera does not know.
            levels[(levels < 0) | (levels > 65535)] = 0
            _write_png(_named(stem, "depth"), levels.astype(np.uint16))
        if overlay is not None:
            _write_rgb(_named(stem, "overlay"), overlay)
        _sync_folder(self.folder / "frames")
        line = {"kind": "observation", "index": self._observations, "iou": iou}
        self._append(self._steps, {**line, "taken_s": frame.timestamp_s})
        self._observations += 1
        return iou

    def show(self, overlay: np.ndarray) -> Path:
        """Replace the last observation's overlay (h, w, 3) uint8; returns its file.

        The file always shows one proposal, whole: people look at it while they are asked.
        """
        self._check_observed("a plan")
        path = _named(self.folder / "frames" / f"{self._observations - 1:03d}", "overlay")
        write_whole(path, _png(_bgr(overlay)))
        return path

    def begin_action(
        self,
        action: PickPlaceAction,
        lift_m: float,
        *,
        pick_pixel: tuple[float, float] | None = None,
        place_pixel: tuple[float, float] | None = None,
    ) -> None:
        """Record an action that is about to begin: one that an error ends has no other line.

        Args:
            action: what is to be done
            lift_m: height of carrying [m]
            pick_pixel: row and column of the pick in the view, where it was chosen there
            place_pixel: the same of the place
        """
        self._check_observed("a plan")
        row = {"kind": "plan", "index": self._actions, "action": _numbers(action, lift_m)}
        self._append(self._steps, {**row, "pick_pixel": pick_pixel, "place_pixel": place_pixel})

    def end_action(
        self,
        action: PickPlaceAction,
        result: PickPlaceResult,
        *,
        pick_pixel: tuple[float, float] | None = None,
        place_pixel: tuple[float, float] | None = None,
    ) -> None:
        """Record an action that has ended, taken on the last observation.

        Args:
            action: what was to be done
            result: what became of it
            pick_pixel: row and column of the pick in the view, where it was chosen there
            place_pixel: the same of the place
        """
        self._check_observed("an action")
        place = result.base_T_place
        self._append(
            self._steps,
            {
                "kind": "action",
                "index": self._actions,
                "action": _numbers(action, result.lift_m),
                "pick_pixel": pick_pixel,
                "place_pixel": place_pixel,
                "pick_xyz": result.base_T_pick[:3, 3].tolist(),
                "place_xyz": None if place is None else place[:3, 3].tolist(),
                "gripper_width_m": result.width_after_grasp_m,
                "gripper_width_after_lift_m": result.width_after_lift_m,
                "max_force_N": result.max_force_N,
                "outcome": str(result.outcome),
            },
        )
        self._actions += 1

    def _check_observed(self, what: str) -> None:
        """Refuse what can only follow an observation.

        Args:
            what: is recorded now, for the message: "an action"

        Raises:
            InputError: since the last action nothing was observed
        """
        if self._observations != self._actions + 1:
            raise InputError(f"{what} follows an observation; record the observation first")

    @contextlib.contextmanager
    def following(self, robot: Robot | SafeRobot, *, rate_hz: float = 10.0) -> Iterator[None]:
        """Record the robot's readings `rate_hz` times a second from another thread while inside.

        Where a reading takes longer, moments are left out. A reading that fails is recorded as
        such; the thread that moves the robot gets the error.

        Raises:
            InputError: a rate that is none; or the readings could not be written, which `observe`,
                `begin_action` and `end_action` raise, too
        """
        if not 0.0 < rate_hz <= 100.0:
            raise InputError(f"rate_hz: above 0, at most 100 Hz, not {rate_hz}")
        ended = threading.Event()
        period = 1.0 / rate_hz

        def follow() -> None:
            due = time.monotonic()
            while True:
                due += period * max(1, math.ceil((time.monotonic() - due) / period))
                if ended.wait(due - time.monotonic()):
                    return
                try:
                    row = _reading(robot.state())
                    json.dumps(row, allow_nan=False)
                except (RobotError, ValueError) as error:  # ValueError: a force that is no number
                    row = {"error": str(error)}
                try:
                    self._append(self._robot, row, sync=False)
                except InputError as error:
                    self._broken = error  # the thread that records the steps raises it
                    return

        thread = threading.Thread(target=follow, daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join(timeout=5.0)
        if self._broken is not None:
            raise self._broken

    def finish(self, outcome: str) -> None:
        """Record how the episode ended: "success", "limit", "stopped", "error: ...", and close."""
        self._meta |= {"outcome": outcome, "seconds": time.monotonic() - self._start}
        write_json(self.folder / "episode.json", self._meta)
        self.close()

    def close(self) -> None:
        """Close the files; the outcome stays open where `finish` was not called.

        Raises:
            InputError: what was still to be written cannot be
        """
        failed: InputError | None = None
        with self._writing:
            for file in (self._steps, self._robot):
                try:
                    if not file.closed:
                        file.flush()
                        os.fsync(file.fileno())
                except OSError as error:
                    failed = _full(file, error)
                with contextlib.suppress(OSError):  # of the flush that it tries again
                    file.close()
        if failed is not None:
            raise failed

    def _end_by(self, error: BaseException) -> None:
        if self._meta["outcome"] is None:
            self.finish(f"error: {type(error).__name__}: {' '.join(str(error).split())}")

    def _append(self, file: BinaryIO, row: dict[str, Any], *, sync: bool = True) -> None:
        row = {**row, "t": time.monotonic() - self._start}
        line = json.dumps(row, allow_nan=False).encode() + b"\n"
        if self._broken is not None:
            raise self._broken
        with self._writing:
            if file.closed:
                return  # a last reading that came after the end
            try:
                file.write(line)
                file.flush()
                if sync:
                    os.fsync(file.fileno())
            except OSError as error:
                raise _full(file, error) from error

    @staticmethod
    def _write_mask(path: Path, mask: np.ndarray) -> None:
        if mask.ndim != 2 or mask.dtype != bool:
            raise InputError(f"a mask is (H, W) bool, not {mask.shape} {mask.dtype}")
        _write_png(path, np.where(mask, 255, 0).astype(np.uint8))


def _numbers(action: PickPlaceAction, lift_m: float) -> list[float]:
    """The action as the dataset's seven numbers."""
    return [*action.pick_xy, action.pick_yaw, *action.place_xy, action.place_yaw, lift_m]


def _reading(state: RobotState) -> dict[str, Any]:
    return {
        "q": state.q.tolist(),
        "base_T_tcp": state.base_T_tcp.tolist(),
        "force_N": state.force_N.tolist(),
        "gripper_width_m": state.gripper_width_m,
        "mode": str(state.mode),
    }


def _full(file: BinaryIO, error: OSError) -> InputError:
    return InputError(
        f"{file.name} cannot be written: {error.strerror}; make room there, or record elsewhere"
    )


def _named(stem: Path, name: str) -> Path:
    return stem.with_name(f"{stem.name}_{name}.png")


def _write_rgb(path: Path, rgb: np.ndarray) -> None:
    _write_png(path, _bgr(rgb))


def _bgr(rgb: np.ndarray) -> np.ndarray:
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8:
        raise InputError(f"a picture is (H, W, 3) uint8, not {rgb.shape} {rgb.dtype}")
    return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))


def _write_png(path: Path, image: np.ndarray) -> None:
    write_whole(path, _png(image))


def _png(image: np.ndarray) -> bytes:
    done, data = cv2.imencode(".png", image, (cv2.IMWRITE_PNG_COMPRESSION, 1))
    if not done:
        raise InputError(f"a picture of shape {image.shape} cannot be written as PNG")
    return data.tobytes()


def _sync_folder(folder: Path) -> None:
    """Put the names of new files on the disk, too."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
