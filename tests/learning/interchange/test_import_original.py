"""Recordings of the original code become episodes that show what the original shows."""

from __future__ import annotations

import io
import json
import shutil
import tarfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fixtures.original_recordings import (
    NUMPY_1,
    NUMPY_2,
    name,
    opcodes,
    pickled,
    recording,
    write,
)
from fixtures.places import TESTS

from learning.interchange.deformable_ravens import import_deformable_ravens
from learning.interchange.original_recording import PARTS, read_recording
from learning.runs.folder import RunFolder, read_snapshot
from warp_deform.collecting.goals import load_goals
from warp_deform.command.main import main
from warp_deform.episodes import HEIGHT_UNIT, EpisodeReader
from warp_deform.errors import InputError
from warp_deform.tasks.registry import TASKS

ARCHIVE = TESTS / "data" / "original_insertion-goal.tar.xz"


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A demonstration that the original recorded, and its own fused maps."""
    folder = tmp_path_factory.mktemp("original")
    with tarfile.open(ARCHIVE) as archive:
        # early releases of Python 3.11 have no filters; the archive is the repository's own
        archive.extractall(
            folder, **({"filter": "data"} if hasattr(tarfile, "data_filter") else {})
        )
    return folder


@pytest.fixture(scope="module")
def maps(original: Path) -> dict[str, np.ndarray]:
    data = io.BytesIO((original / "insertion-goal_fused.npz").read_bytes())
    with np.load(data, allow_pickle=False) as fused:
        return {key: fused[key] for key in fused.files}


def test_the_maps_are_the_originals_own(original: Path, maps: dict[str, np.ndarray]) -> None:
    recording = read_recording(
        original / "insertion-goal", number=0, steps=1, task="block-notarget"
    )
    for step, color, height in zip(recording.steps, maps["color"], maps["height"], strict=True):
        assert_nearly_the_same_colors(step.color, color)
        np.testing.assert_array_equal(step.height, height)


def assert_nearly_the_same_colors(color: np.ndarray, original: np.ndarray) -> None:
    """Which of two equally high points gives a cell its colour, the original leaves to chance."""
    levels = np.abs(color.astype(int) - original).max(axis=-1)
    assert np.mean(levels > 0) < 0.005
    assert levels.max() <= 4


def test_a_recorded_demonstration_becomes_an_episode(
    original: Path, maps: dict[str, np.ndarray], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    source, target = str(original / "insertion-goal"), str(tmp_path / "demos")
    assert main(["convert", source, target, "--from", "deformable-ravens", "--json"]) == 0
    report = json.loads(capfd.readouterr().out)
    assert (report["task"], report["episodes"], report["steps"]) == ("block-notarget", 1, 1)
    assert [path.name for path in tmp_path.iterdir()] == ["demos"]
    episode = EpisodeReader(tmp_path / "demos").read(0)
    info, (first, last) = episode.info, episode.steps
    assert (info.success, info.score, info.demonstrator, info.robot) == (
        True,
        1.0,
        "original",
        "ur5",
    )
    assert (first.success, last.success) == (False, True)
    for step, color, height in zip(episode.steps, maps["color"], maps["height"], strict=True):
        assert_nearly_the_same_colors(step.color, color)
        np.testing.assert_allclose(step.height, height, atol=0.5 * HEIGHT_UNIT + 3e-8, rtol=0)
    # The block went where and turned as the action says, up to a slip of millimetres and degrees.
    assert first.action is not None
    assert first.action[6] == TASKS["block-notarget"].stages[0].lift
    (before,), (after,) = first.body_q, last.body_q
    turn = first.action[5] - first.action[2]
    offset = before[:2] - first.action[:2]
    turned = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]] @ offset
    np.testing.assert_allclose(first.action[3:5] + turned, after[:2], atol=2e-3)
    assert episode.goal is not None
    yaw = 2 * np.arctan2(before[5], before[6]) + turn
    assert abs(np.angle(np.exp(1j * (episode.goal.targets[2] - yaw)))) < np.radians(2)
    # As a goal it is one of the environment's.
    (goal,) = load_goals(tmp_path / "demos")
    np.testing.assert_array_equal(goal.color, last.color)
    np.testing.assert_allclose(goal.targets[:2], after[:2])


def test_it_is_learnt_from(original: Path, tmp_path: Path) -> None:
    demos, run = str(tmp_path / "demos"), str(tmp_path / "run")
    source = str(original / "insertion-goal")
    assert main(["convert", source, demos, "--from", "deformable-ravens"]) == 0
    what = ["block-notarget", "--agent", "goal-split", "--preset", "fast", "--data", demos]
    assert main(["train", *what, "--steps", "2", "--snapshots", "2", "--validate", "0",
                 "--out", run]) == 0  # fmt: skip
    first, second = (read_snapshot(RunFolder(Path(run)).snapshot(step))[0] for step in (1, 2))
    assert any(not torch.equal(first[name], second[name]) for name in first)


@pytest.mark.parametrize("multiarray", [NUMPY_1, NUMPY_2])
def test_recordings_of_either_numpy(tmp_path: Path, multiarray: str) -> None:
    source = write(tmp_path / "cable-ring", 3, recording(2), multiarray=multiarray)
    report = import_deformable_ravens(source, tmp_path / "out")
    assert (report.task, report.episodes, report.steps) == ("cable-ring", 1, 2)
    episode = EpisodeReader(tmp_path / "out").read(3)
    assert episode.goal is None
    for step, action in zip(episode.steps, recording(2)["action"], strict=False):
        assert step.action is not None
        for pose, read in zip(("pose0", "pose1"), (step.action[:3], step.action[3:6]), strict=True):
            position, quat_xyzw = action["params"][pose]
            expected = [*position[:2], 2 * np.arctan2(quat_xyzw[2], quat_xyzw[3])]
            np.testing.assert_allclose(read, expected, atol=1e-12)
    assert (np.array([step.height.max() for step in episode.steps]) > 0.1).all()


FABRIC = {5: (4, tuple((0.4 + 0.01 * i, 0.1, 0.002) for i in range(4)))}


@pytest.mark.parametrize(
    ("folder", "task", "extras", "score"),
    [
        ("cable-ring-notarget", "cable-ring-notarget", {"fraction": 0.6}, 0.6),
        ("cable-ring", "cable-ring", {"fraction": 1.2}, 1.0),
        ("cable-shape", "cable-shape", {"nb_zone": 6, "nb_beads": 24}, 0.25),
        ("cloth-cover", "fabric-cover", {"is_item_covered": True}, 1.0),
        ("cloth-flat-notarget", "fabric-flat-notarget", {"cloth_coverage": np.float64(0.5)}, 0.5),
        (
            "bag-alone-open_1000_demos",
            "bag-alone-open",
            {"convex_hull_area": 0.01, "best_possible_area": 0.02},
            0.5,
        ),
        ("bag-alone-open", "bag-alone-open", {"convex_hull_area": 0.01}, 1.0),
        ("bag-color-goal", "bag-color-goal", {"frac_in_target_bag": 0.97, "task_stage": 1}, 0.97),
        ("bag-items-2", "bag-items-2", {"task_stage": 3, "reward": np.inf}, 1.0),
    ],
)
def test_names_scores_and_lifts(
    tmp_path: Path, folder: str, task: str, extras: dict[str, Any], score: float
) -> None:
    source = write(tmp_path / folder, 0, recording(1, objects=FABRIC, **extras))
    import_deformable_ravens(source, tmp_path / "out")
    episode = EpisodeReader(tmp_path / "out").read(0)
    assert episode.info.task == task
    assert episode.info.score == pytest.approx(score)
    stage = TASKS[task].stages[extras.get("task_stage", 1) - 1]
    assert episode.steps[0].action is not None
    assert episode.steps[0].action[6] == stage.lift
    np.testing.assert_allclose(episode.steps[0].particle_q, FABRIC[5][1], atol=1e-7)
    assert episode.info.extra["original"]["extras"][0].keys() == {"task.done", *extras}
    assert (episode.goal is not None) == TASKS[task].goal_conditioned


def test_a_stage_belongs_to_the_action_that_led_to_it(tmp_path: Path) -> None:
    parts = recording(3)
    for info, stage in zip([*parts["info"], parts["last_info"]], (1, 1, 2, 3), strict=True):
        info["extras"]["task_stage"] = stage
    import_deformable_ravens(write(tmp_path / "bag-items-1", 0, parts), tmp_path / "out")
    steps = EpisodeReader(tmp_path / "out").read(0).steps
    lifts = [step.action[6] for step in steps if step.action is not None]
    assert lifts == [stage.lift for stage in TASKS["bag-items-1"].stages]


@pytest.mark.parametrize(
    ("task", "items", "beads", "solved"),
    [
        ("bag-items-1", 0.5, 0.4, True),
        ("bag-items-1", 0.0, 0.4, False),
        ("bag-items-1", 0.5, 0.0, False),
        ("bag-items-2", 0.5, 0.1, True),
        ("bag-items-2", 0.25, 0.5, False),
    ],
)
def test_a_bag_that_came_without_its_items_is_over_but_no_success(
    tmp_path: Path, task: str, items: float, beads: float, solved: bool
) -> None:
    extras = {"task_stage": 3, "zone_items_rew": items, "zone_beads_rew": beads}
    source = write(tmp_path / task, 0, recording(1, objects=FABRIC, **extras))
    import_deformable_ravens(source, tmp_path / "out")
    info = EpisodeReader(tmp_path / "out").read(0).info
    assert info.score == pytest.approx(items + beads) and info.success is solved


def test_goals_of_cables_are_their_beads(tmp_path: Path) -> None:
    beads = {4 + i: ((0.4, 0.01 * i, 0.005), (0.0, 0.0, 0.0, 1.0)) for i in range(24)}
    source = write(tmp_path / "cable-line-notarget", 0, recording(1, objects=beads))
    import_deformable_ravens(source, tmp_path / "out")
    (goal,) = load_goals(tmp_path / "out")
    np.testing.assert_allclose(goal.targets[:, 1], 0.01 * np.arange(24), atol=1e-7)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda p: p["info"].pop(), "has 2 actions and 1 infos"),
        (lambda p: p.update(action={}), "no lists of actions"),
        (lambda p: p.update(color=p["color"][:1]), "no 2 observations"),
        (lambda p: p.update(color=p["color"].astype(float)), "unknown form"),
        (lambda p: p.update(depth=p["depth"].astype(float)), "unknown form"),
        (lambda p: p.update(last_depth=np.zeros((2, 3, 3), np.float32)), "must be"),
        (lambda p: p.update(last_color=np.zeros((2, 1, 1921, 3), np.uint8)), "too large"),
        (lambda p: p["action"][0].update(primitive="push"), "'push' is no pick_place"),
        (lambda p: p["action"][0].pop("params"), "KeyError: 'params'"),
        (
            lambda p: p["action"][0]["params"].update(pose0=((1.0, np.nan, 0.0), (0, 0, 0, 1))),
            "fin",
        ),
        (lambda p: p["action"][1]["camera_config"].pop(), "fuse needs"),
        (lambda p: p["action"][1]["camera_config"][0].update(image_size=(9, 9)), "size"),
        (lambda p: p["action"][1]["camera_config"][0].update(rotation=(0, 0, 0, 0)), "norm"),
        (lambda p: p["info"][0].pop("extras"), "KeyError: 'extras'"),
        (lambda p: p["info"][0]["extras"].pop("task.done"), "KeyError: 'task.done'"),
        (lambda p: p["info"][0]["extras"].update({"fraction": [1]}), "TypeError"),
        (lambda p: p["info"][0].update({9: (3, ((0.0, 0.0, 0.0),))}), "is not 9 finite numbers"),
        (lambda p: p["info"][0].update({9: 3}), "TypeError"),
        (lambda p: p.update(info=[1, 2]), "TypeError"),
    ],
)
def test_what_the_original_never_writes(tmp_path: Path, change: Any, expected: str) -> None:
    parts = recording(2)
    for key, value in parts.items():  # every test changes its own
        parts[key] = list(value) if isinstance(value, list) else value
    change(parts)
    source = tmp_path / "cable-ring"
    for part, value in parts.items():
        path = source / part / "000000-2.pkl"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(pickled(value))
    with pytest.raises(InputError, match=expected) as refused:
        import_deformable_ravens(source, tmp_path / "out")
    assert "episode 000000-2" in str(refused.value)
    assert not (tmp_path / "out").exists()


def test_no_stage_no_lift(tmp_path: Path) -> None:
    source = write(tmp_path / "bag-items-1", 0, recording(1))
    with pytest.raises(InputError, match="stages of its actions"):
        import_deformable_ravens(source, tmp_path / "out")


@pytest.mark.parametrize("part", PARTS)
def test_a_payload_anywhere_is_refused_and_not_run(
    tmp_path: Path, part: str, capsys: pytest.CaptureFixture[str]
) -> None:
    source, mark = write(tmp_path / "cable-ring", 0, recording(1)), tmp_path / "mark"
    attack = name("os", "system") + b"(" + opcodes(f"touch {mark}") + b"tR."
    (source / part / "000000-1.pkl").write_bytes(b"\x80\x03" + attack)
    out = str(tmp_path / "out")
    assert main(["convert", str(source), out, "--from", "deformable-ravens"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert f"{part}/000000-1.pkl asks for 'os.system'" in said
    assert not mark.exists() and not (tmp_path / "out").exists()


def test_folders_that_are_no_recordings(tmp_path: Path) -> None:
    source, out = write(tmp_path / "cable-ring", 0, recording(1)), tmp_path / "out"
    (tmp_path / "other").mkdir()
    with pytest.raises(InputError, match="--task"):
        import_deformable_ravens(tmp_path / "other", out)
    with pytest.raises(InputError, match="there is no task 'cable'"):
        import_deformable_ravens(source, out, task="cable")
    with pytest.raises(InputError, match="no folder 'color'"):
        import_deformable_ravens(tmp_path / "other", out, task="cable-ring")
    (source / "depth" / "notes.txt").touch()
    with pytest.raises(InputError, match=r"depth/notes\.txt is not named"):
        import_deformable_ravens(source, out)
    (source / "depth" / "notes.txt").unlink()
    shutil.copytree(source, tmp_path / "twice" / "cable-ring")
    write(tmp_path / "twice" / "cable-ring", 0, recording(2))
    with pytest.raises(InputError, match="two episodes of number 0"):
        import_deformable_ravens(tmp_path / "twice" / "cable-ring", out)
    (source / "last_info" / "000000-1.pkl").unlink()
    with pytest.raises(InputError, match=r"last_info/000000-1\.pkl is missing"):
        import_deformable_ravens(source, out)
    for part in PARTS:
        (source / part / "000000-1.pkl").unlink(missing_ok=True)
    with pytest.raises(InputError, match="holds no episodes"):
        import_deformable_ravens(source, out)
    assert not out.exists()


def test_an_import_goes_on_where_it_stopped(tmp_path: Path) -> None:
    source, out = tmp_path / "cable-ring", tmp_path / "out"
    for number in range(3):
        write(source, number, recording(1, seed=number))
    damaged = source / "depth" / "000002-1.pkl"
    whole = damaged.read_bytes()
    damaged.write_bytes(whole[:-100])
    with pytest.raises(InputError, match=r"000002-1\.pkl is damaged"):
        import_deformable_ravens(source, out)
    partial = {path.name: path.stat() for path in (tmp_path / ".out.partial").glob("*.parquet")}
    assert len(partial) == 2 and not out.exists()
    damaged.write_bytes(whole)
    assert import_deformable_ravens(source, out).episodes == 3
    assert EpisodeReader(out).seeds == (0, 1, 2)
    for name_, status in partial.items():
        assert (out / name_).stat().st_ino == status.st_ino
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cable-ring", "out"]
    # the same bytes as without the interruption
    import_deformable_ravens(source, tmp_path / "again")
    for path in out.glob("*.parquet"):
        assert (tmp_path / "again" / path.name).read_bytes() == path.read_bytes()
    with pytest.raises(InputError, match="exists already"):
        import_deformable_ravens(source, out)
