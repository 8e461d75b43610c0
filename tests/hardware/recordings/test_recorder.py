"""Recording an episode: nothing is lost to a kill, and what is kept can be scored and packed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from fixtures.places import ROOT, SHARED
from fixtures.record_until_killed import ACTION, CONFIG, INTRINSICS, frame, mask, observe, result

from hardware import RobotState
from hardware.arm.pick_place import PickPlaceOutcome
from hardware.backends.dry_run import DryRunRobot
from hardware.cameras.camera import FileCamera
from hardware.recordings.pack import pack
from hardware.recordings.recorder import EpisodeRecorder
from hardware.recordings.recording import Recording
from hardware.recordings.scoring import SUCCESS_IOU, score_masks, score_recording
from warp_deform.episodes import EpisodeReader, EpisodeWriter
from warp_deform.errors import InputError
from warp_deform.tasks.metrics import mask_iou

GOAL = mask(0)
PLANNED = json.dumps({"kind": "plan", "index": 0})


def record(
    folder: Path,
    shifts: tuple[int, ...] = (4, 2, 1),
    *,
    finish: bool = True,
    goal: np.ndarray | None = GOAL,
) -> None:
    """An episode whose cable is `shifts` pixels from the goal, before and after each action."""
    with EpisodeRecorder(folder, CONFIG, goal_mask=goal) as recorder:
        for number, shift in enumerate(shifts):
            observe(recorder, number, shift)
            if number < len(shifts) - 1:
                missed = PickPlaceOutcome.MISSED_GRASP if number else PickPlaceOutcome.PLACED
                recorder.end_action(ACTION, result(missed), pick_pixel=(12.0, 7.5))
        if finish:
            recorder.finish("success")


def test_what_is_recorded_is_read(tmp_path: Path) -> None:
    record(tmp_path / "a")
    recording = Recording.read(tmp_path / "a")
    assert recording.meta["outcome"] == "success" and recording.warnings == ()
    assert recording.meta["config"] == {"beads": 40} and recording.meta["calibration"] == "ab12"
    assert [row["outcome"] for row in recording.actions] == ["placed", "missed_grasp"]
    assert recording.actions[0]["action"] == [0.4, 0.1, 0.2, 0.5, -0.1, 0.3, 0.08]
    assert recording.actions[0]["pick_pixel"] == [12.0, 7.5]
    assert recording.actions[1]["place_xyz"] is None
    for i, shift in enumerate((4, 2, 1)):
        np.testing.assert_array_equal(recording.mask(i), mask(shift))
        assert recording.observations[i]["iou"] == mask_iou(mask(shift), mask(0))
    assert (recording.view(2) == 2).all()
    times = [row["t"] for row in recording.observations]
    assert times == sorted(times)


def test_the_frames_replay(tmp_path: Path) -> None:
    record(tmp_path / "a")
    camera = FileCamera(tmp_path / "a" / "frames", INTRINSICS)
    frames = [camera.read() for _ in range(len(camera))]
    assert [f.rgb[0, 0, 0] for f in frames] == [0, 1, 2]
    np.testing.assert_allclose(frames[0].depth_m, 0.5, atol=1e-4)


def test_scores_are_computed_from_the_files(tmp_path: Path) -> None:
    record(tmp_path / "a")
    score = score_recording(tmp_path / "a")
    assert score.iou == tuple(mask_iou(mask(shift), mask(0)) for shift in (4, 2, 1))
    assert score.best == tuple(np.maximum.accumulate(score.iou))
    assert score.success and score.actions_to_success == 1 and score.warnings == ()
    lines = (tmp_path / "a" / "steps.jsonl").read_text().splitlines()
    row = json.loads(lines[2])
    lines[2] = json.dumps({**row, "iou": 0.9})
    (tmp_path / "a" / "steps.jsonl").write_text("\n".join(lines) + "\n")
    again = score_recording(tmp_path / "a")
    assert again.iou == score.iou
    assert again.warnings == ()
    assert again.differences == (f"picture 1: recorded 0.9000, its files give {score.iou[1]:.4f}",)


def test_a_dry_run_is_said_to_be_one(tmp_path: Path) -> None:
    record(tmp_path / "a")
    path = tmp_path / "a" / "episode.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "config": {"executed": False}}))
    (warning,) = score_recording(tmp_path / "a").warnings
    assert "nothing moved" in warning


def test_scores_of_masks() -> None:
    goal, far = mask(0), np.zeros((40, 20), bool)
    assert score_masks([mask(3)], goal).iou[0] < SUCCESS_IOU
    late = score_masks([far] * 11 + [goal], goal)
    assert late.best[-1] == 1.0 and not late.success, "the eleventh action does not count"
    assert score_masks([far] * 10 + [goal], goal).actions_to_success == 10
    assert score_masks([far, goal, far], goal).success, "at any time"
    for masks in ([goal], [goal, far], [goal, far, goal]):
        begun = score_masks(masks, goal)
        assert begun.at_start and not begun.success and begun.actions_to_success is None
        assert "began at its goal" in begun.warnings[-1]
    both = score_masks([far], far)
    assert both.iou == (0.0,) and len(both.warnings) == 2
    for masks, message in (([], "no score"), ([far[:5]], "use one view")):
        with pytest.raises(InputError, match=message):
            score_masks(masks, goal)


def test_an_episode_without_a_goal_shows_how_to_reach_where_it_ended(tmp_path: Path) -> None:
    record(tmp_path / "a", (8, 4, 1), goal=None)
    episode = pack(tmp_path / "a", seed=0)
    assert episode.info.success and episode.info.extra["hindsight"] and episode.info.score == 1.0
    assert [step.score for step in episode.steps] == [
        mask_iou(mask(shift), mask(1)) for shift in (8, 4, 1)
    ]
    assert episode.goal is not None
    np.testing.assert_array_equal(episode.goal.color[..., 0] > 0, mask(1))
    seen = pack(tmp_path / "a", seed=0, images="view")
    assert seen.goal is not None and (seen.goal.color == 2).all()


@pytest.mark.parametrize("steps", [1, 4, 9])
def test_a_killed_recorder_loses_the_step_in_flight_only(tmp_path: Path, steps: int) -> None:
    folder = tmp_path / "a"
    process = subprocess.Popen(
        [sys.executable, str(SHARED / "fixtures" / "record_until_killed.py"), str(folder)],
        stdout=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert process.stdout is not None
    told = [int(process.stdout.readline()) for _ in range(steps)]
    process.send_signal(signal.SIGKILL)
    told += [int(line) for line in process.stdout.read().split()]
    process.stdout.close()
    assert process.wait(10) == -signal.SIGKILL
    recording = Recording.read(folder)
    assert len(recording.actions) >= len(told)
    assert any("not finished" in warning for warning in recording.warnings)
    score = score_recording(folder)
    assert score.iou == tuple(
        mask_iou(mask(5 - i % 6), mask(0)) for i in range(len(recording.observations))
    )
    assert len(FileCamera(folder / "frames", INTRINSICS)) >= len(recording.observations)
    # the arm is followed beside the steps, which may all be over before its first row
    assert all(len(row["q"]) == 7 for row in recording.robot)
    episode = pack(folder, seed=7)
    assert len(episode.steps) == len(recording.observations)
    EpisodeWriter(tmp_path / "data").write(episode)


def test_every_torn_end_can_be_read(tmp_path: Path) -> None:
    """Cut the lines anywhere: what is whole before the cut is read, and never an error."""
    record(tmp_path / "a")
    path = tmp_path / "a" / "steps.jsonl"
    data = path.read_bytes()
    first = data.index(b"\n") + 1
    for end in [*range(first, len(data), 37), len(data)]:
        path.write_bytes(data[:end])
        recording = Recording.read(tmp_path / "a")
        whole = data[:end].count(b"\n")
        assert len(recording.observations) + len(recording.actions) == whole
        assert score_recording(tmp_path / "a").iou


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda lines: lines[1:], "two actions in a row"),
        (lambda lines: [lines[0], lines[2]], "two observations in a row"),
        (lambda lines: [lines[0], "{", *lines[1:]], "line 2 is not JSON"),
        (lambda lines: [lines[0], "[]"], "line 2 is no JSON object"),
        (lambda lines: [lines[0].replace('"index": 0', '"index": 3')], "index 3, expected 0"),
        (lambda lines: [lines[0].replace("observation", "dream")], "kind 'dream'"),
        (lambda lines: [*lines[:1], PLANNED, PLANNED], "two plans in a row"),
        (lambda lines: [*lines[:3], PLANNED], "index 0, expected 1"),
        (lambda lines: [], "before its first picture"),
    ],
)
def test_damage_that_no_kill_makes_is_one_line(
    tmp_path: Path, change: object, message: str
) -> None:
    record(tmp_path / "a")
    path = tmp_path / "a" / "steps.jsonl"
    lines = change(path.read_text().splitlines())
    path.write_text("".join(line + "\n" for line in lines))
    with pytest.raises(InputError, match=message) as caught:
        Recording.read(tmp_path / "a")
    assert "\n" not in str(caught.value)


def test_missing_files_and_folders(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"recording .*episode\.json cannot be read"):
        Recording.read(tmp_path)
    record(tmp_path / "a")
    with pytest.raises(InputError, match="holds an episode already"):
        EpisodeRecorder(tmp_path / "a", CONFIG)
    (tmp_path / "a" / "frames" / "001_mask.png").unlink()
    with pytest.raises(InputError, match=r"001_mask\.png cannot be read"):
        score_recording(tmp_path / "a")


def test_steps_come_in_turn(tmp_path: Path) -> None:
    with EpisodeRecorder(tmp_path / "a", CONFIG) as recorder:
        with pytest.raises(InputError, match="observation first"):
            recorder.end_action(ACTION, result())
        with pytest.raises(InputError, match="observation first"):
            recorder.show(np.zeros((4, 4, 3), np.uint8))
        with pytest.raises(InputError, match="observation first"):
            recorder.begin_action(ACTION, 0.05)
        assert observe(recorder, 0, 1) is None
        with pytest.raises(InputError, match="action first"):
            observe(recorder, 1, 1)
        recorder.end_action(ACTION, result())
        with pytest.raises(InputError, match="differ in size"):
            recorder.observe(frame(0), np.zeros((4, 4, 3), np.uint8), mask(0))
        recorder.finish("limit")
    with pytest.raises(InputError, match="without a goal"):
        score_recording(tmp_path / "a")
    assert not pack(tmp_path / "a", seed=0).info.success


def test_an_error_becomes_the_outcome(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), EpisodeRecorder(tmp_path / "a", CONFIG) as recorder:
        observe(recorder, 0, 1)
        raise RuntimeError("the arm\nstopped")
    meta = json.loads((tmp_path / "a" / "episode.json").read_text())
    assert meta["outcome"] == "error: RuntimeError: the arm stopped"


def test_the_robot_is_followed(tmp_path: Path) -> None:
    with EpisodeRecorder(tmp_path / "a", CONFIG) as recorder:
        observe(recorder, 0, 1)
        with recorder.following(DryRunRobot(), rate_hz=100.0):
            deadline = 200
            while recorder._robot.tell() < 3000 and deadline:
                deadline -= 1
                time.sleep(0.02)
        with (
            pytest.raises(InputError, match="rate_hz"),
            recorder.following(DryRunRobot(), rate_hz=0.0),
        ):
            pass
    rows = Recording.read(tmp_path / "a").robot
    assert len(rows) >= 3 and rows[0]["mode"] == "idle" and len(rows[0]["force_N"]) == 6


def test_an_action_that_does_not_end_leaves_its_plan(tmp_path: Path) -> None:
    with EpisodeRecorder(tmp_path / "a", CONFIG, goal_mask=GOAL) as recorder:
        for number in range(2):
            observe(recorder, number, 4 - number)
            recorder.begin_action(ACTION, 0.08, pick_pixel=(1.0, 2.0))
            if number == 0:
                recorder.end_action(ACTION, result())
        recorder.finish("error: MotionError: ended elsewhere")
    recording = Recording.read(tmp_path / "a")
    assert len(recording.actions) == 1 and len(recording.plans) == 2
    assert recording.plans[1]["action"] == recording.actions[0]["action"]
    assert recording.plans[1]["pick_pixel"] == [1.0, 2.0]
    assert recording.warnings == ("action 2 was begun, and did not end",)
    assert score_recording(tmp_path / "a").warnings == recording.warnings
    episode = pack(tmp_path / "a", seed=0)
    assert episode.info.actions == 1 and episode.info.extra["actions_after_last_picture"] == 0


class Clock:
    """Time that passes while the robot is read and while the next reading is waited for [s]."""

    def __init__(self, *, reading: float, readings: int) -> None:
        self.now, self.reading, self.left = 0.0, reading, readings
        self.done = threading.Event()

    def monotonic(self) -> float:
        return self.now

    def wait(self, seconds: float) -> bool:
        """As the event that ends the following does."""
        self.now += max(seconds, 0.0)
        self.left -= 1
        if self.left < 0:
            self.done.set()
        return self.left < 0

    def set(self) -> None:
        pass


@pytest.mark.parametrize(("reading", "apart"), [(0.0, 0.1), (0.04, 0.1), (0.13, 0.2)])
def test_readings_keep_their_rate_whatever_one_takes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reading: float, apart: float
) -> None:
    clock = Clock(reading=reading, readings=6)

    class Slow(DryRunRobot):
        def state(self) -> RobotState:
            clock.now += clock.reading
            return super().state()

    with EpisodeRecorder(tmp_path / "a", CONFIG) as recorder:
        observe(recorder, 0, 1)
        monkeypatch.setattr("hardware.recordings.recorder.time", clock)
        names = SimpleNamespace(Event=lambda: clock, Thread=threading.Thread)
        monkeypatch.setattr("hardware.recordings.recorder.threading", names)
        recorder._start = 0.0
        with recorder.following(Slow()):
            assert clock.done.wait(30.0)
        monkeypatch.undo()
        recorder.finish("limit")
    times = [row["t"] for row in Recording.read(tmp_path / "a").robot]
    np.testing.assert_allclose(np.diff(times), apart, atol=1e-9)
    assert len(times) == 6


def test_a_full_disk_is_said(tmp_path: Path) -> None:
    with (
        Path("/dev/full").open("wb") as full,
        pytest.raises(InputError, match="No space left on device; make room"),
        EpisodeRecorder(tmp_path / "a", CONFIG) as recorder,
    ):
        observe(recorder, 0, 1)
        recorder._robot.close()
        recorder._robot = full
        with recorder.following(DryRunRobot(), rate_hz=100.0):
            for _ in range(3000):
                if recorder._broken is not None:
                    break
                time.sleep(0.01)
            with pytest.raises(InputError, match="No space left"):
                recorder.begin_action(ACTION, 0.05)
    with (
        Path("/dev/full").open("wb") as full,
        pytest.raises(InputError, match="No space left on device; make room"),
        EpisodeRecorder(tmp_path / "b", CONFIG) as recorder,
    ):
        recorder._steps.close()
        recorder._steps = full
        observe(recorder, 0, 1)
    assert json.loads((tmp_path / "b" / "episode.json").read_text())["outcome"].startswith("error")


@pytest.mark.parametrize("images", ["mask", "view"])
def test_packing_gives_an_episode_of_the_dataset(tmp_path: Path, images: str) -> None:
    record(tmp_path / "a")
    EpisodeWriter(tmp_path / "data").write(pack(tmp_path / "a", seed=3, images=images))
    episode = EpisodeReader(tmp_path / "data").read(3)
    assert episode.info.success and episode.info.actions == 2
    assert episode.info.robot == "panda" and episode.info.demonstrator == "human"
    assert [step.outcome for step in episode.steps] == ["placed", "missed_grasp", None]
    assert [step.success for step in episode.steps] == [False, True, True]
    np.testing.assert_allclose(episode.steps[0].action, [0.4, 0.1, 0.2, 0.5, -0.1, 0.3, 0.08])
    assert episode.goal is not None
    seen = episode.steps[1].color
    if images == "mask":
        np.testing.assert_array_equal(seen[..., 0] > 127, mask(2))
        np.testing.assert_array_equal(episode.goal.color[..., 2] > 127, mask(0))
    else:
        assert (seen == 1).all()


def test_an_action_after_the_last_picture_is_left_out_and_counted(tmp_path: Path) -> None:
    record(tmp_path / "a", (4, 3), finish=False)
    recorder_lines = (tmp_path / "a" / "steps.jsonl").read_text().splitlines()
    path = tmp_path / "a" / "steps.jsonl"
    path.write_text("\n".join(recorder_lines[:2]) + "\n")
    episode = pack(tmp_path / "a", seed=0)
    assert episode.info.actions == 0 and episode.info.extra["actions_after_last_picture"] == 1
    assert not episode.info.success
