"""Records one step after another until it is killed; `record` is what the tests call in-process."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np

from hardware.arm.pick_place import PickPlaceAction, PickPlaceOutcome, PickPlaceResult
from hardware.backends.dry_run import DryRunRobot
from hardware.cameras.camera import CameraIntrinsics, Frame
from hardware.recordings.recorder import EpisodeRecorder, RecorderConfig

INTRINSICS = CameraIntrinsics(
    (64, 48), np.array([[60.0, 0, 31.5], [0, 60, 23.5], [0, 0, 1]]), np.zeros(5)
)
ACTION = PickPlaceAction((0.4, 0.1), 0.2, (0.5, -0.1), 0.3)
CONFIG = RecorderConfig(
    robot_id="panda", camera_id="wrist", actor="human", calibration="ab12", config={"beads": 40}
)


def mask(shift: int) -> np.ndarray:
    """A bar of 32 x 4 pixels that moves towards the goal's, which is at 0."""
    made = np.zeros((40, 20), bool)
    made[4:36, 2 + shift : 6 + shift] = True
    return made


def result(outcome: PickPlaceOutcome = PickPlaceOutcome.PLACED) -> PickPlaceResult:
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    place = T if outcome == PickPlaceOutcome.PLACED else None
    return PickPlaceResult(outcome, T, place, 0.004, 0.004, 0.08, 2.5)


def frame(number: int, *, depth: bool = False) -> Frame:
    rgb = np.full((48, 64, 3), number % 256, np.uint8)
    depth_m = np.full((48, 64), 0.5, np.float32) if depth else None
    return Frame(rgb, depth_m, INTRINSICS, time.time())


def observe(recorder: EpisodeRecorder, number: int, shift: int) -> float | None:
    view = np.full((40, 20, 3), number % 256, np.uint8)
    return recorder.observe(frame(number, depth=True), view, mask(shift), overlay=view)


def main() -> None:
    """Record for ever, and say so once a step is on the disk."""
    recorder = EpisodeRecorder(Path(sys.argv[1]), CONFIG, goal_mask=mask(0))
    with recorder.following(DryRunRobot(), rate_hz=100.0):
        for number in range(10_000):
            observe(recorder, number, 5 - number % 6)
            recorder.act(ACTION, result())
            print(number, flush=True)


if __name__ == "__main__":
    main()
