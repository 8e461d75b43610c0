"""Exports hold what the episodes hold, in the places where LeRobot and robomimic look for it."""

from __future__ import annotations

import dataclasses
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pyarrow.parquet as pq
import pytest
from fixtures.episode_samples import make_episode, with_info, with_step

from learning.interchange import conversion, lerobot
from learning.interchange.conversion import ConversionReport, new_folder
from learning.interchange.lerobot import SIDECAR, export_lerobot
from learning.interchange.lerobot_columns import ACTION_NAMES
from learning.interchange.robomimic import STATE_PARTS, export_robomimic
from learning.interchange.running_statistics import RunningStatistics
from warp_deform.command.main import main
from warp_deform.episodes import Episode, EpisodeReader, EpisodeWriter
from warp_deform.errors import InputError

COUNT = 12
EXPORTS: dict[str, tuple[Callable[[Path, Path], ConversionReport], str]] = {
    "lerobot": (export_lerobot, "out"),
    "robomimic": (export_robomimic, "out.hdf5"),
}


def collect(folder: Path, *episodes: Episode) -> Path:
    for episode in episodes:
        EpisodeWriter(folder).write(episode)
    return folder


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("source")
    return collect(folder, *(make_episode(s, actions=1 + s % 3, goal=True) for s in range(COUNT)))


@pytest.fixture(scope="module")
def episodes(source: Path) -> list[Episode]:
    return list(EpisodeReader(source))


@pytest.fixture(scope="module")
def dataset(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("export") / "dataset"
    report = export_lerobot(source, folder)
    assert (report.episodes, report.steps) == (COUNT, sum(1 + s % 3 for s in range(COUNT)))
    return folder


def picture(cell: dict[str, Any]) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(cell["bytes"], np.uint8), cv2.IMREAD_UNCHANGED)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def test_lerobot_frames_are_the_episodes(dataset: Path, episodes: list[Episode]) -> None:
    rows = pq.read_table(dataset / "data/chunk-000/file-000.parquet").to_pylist()
    index = 0
    for number, episode in enumerate(episodes):
        for t, step in enumerate(episode.steps[:-1]):
            row, after = rows[index], episode.steps[t + 1]
            assert episode.goal is not None and step.action is not None
            np.testing.assert_array_equal(picture(row["observation.images.color"]), step.color)
            np.testing.assert_array_equal(
                picture(row["observation.images.goal"]), episode.goal.color
            )
            for key, expected in (
                ("observation.height", step.height),
                ("observation.goal_height", episode.goal.height),
                ("ground_truth", step.ground_truth),
                ("action", step.action.astype(np.float32)),
            ):
                np.testing.assert_array_equal(np.array(row[key], np.float32), expected)
            assert row["next.reward"] == np.float32(after.score - step.score)
            assert row["next.success"] == after.success
            assert row["next.done"] == (t == episode.info.actions - 1)
            assert (row["timestamp"], row["frame_index"], row["index"]) == (t, t, index)
            assert (row["episode_index"], row["task_index"]) == (number, 0)
            index += 1
    assert index == len(rows)


def test_lerobot_keeps_the_rest_beside(dataset: Path, episodes: list[Episode]) -> None:
    rows = pq.read_table(dataset / SIDECAR).to_pylist()
    for row, episode in zip(rows, episodes, strict=True):
        last = episode.steps[-1]
        assert json.loads(row["info"]) == json.loads(json.dumps(dataclasses.asdict(episode.info)))
        np.testing.assert_array_equal(picture(row["final_color"]), last.color)
        np.testing.assert_array_equal(np.array(row["final_height"], np.float32), last.height)
        assert (row["final_success"], row["final_score"]) == (last.success, last.score)


def test_lerobot_metadata_is_version_3(dataset: Path, episodes: list[Episode]) -> None:
    info = json.loads((dataset / "meta/info.json").read_text())
    frames = sum(episode.info.actions for episode in episodes)
    assert info["codebase_version"] == "v3.0"
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (COUNT, frames, 1)
    assert (info["fps"], info["chunks_size"], info["data_files_size_in_mb"]) == (1, 1000, 100)
    assert info["splits"] == {"train": f"0:{COUNT}"}
    assert info["robot_type"] == "ur5"
    data = info["data_path"].format(chunk_index=0, file_index=0)
    table = pq.read_table(dataset / data)
    assert set(info["features"]) == set(table.column_names)
    standard = {"timestamp", "frame_index", "episode_index", "index", "task_index"}
    assert standard <= set(info["features"])
    features = info["features"]
    assert features["action"] == {
        "dtype": "float32",
        "shape": [7],
        "names": list(ACTION_NAMES),
    }
    assert features["observation.images.color"] == {
        "dtype": "image",
        "shape": [16, 12, 3],
        "names": ["height", "width", "channels"],
    }
    for feature in features.values():
        assert len(feature["names"]) == feature["shape"][0] or feature["names"][0] == "height"
    tasks = pq.read_table(dataset / "meta/tasks.parquet")
    assert tasks.to_pylist() == [{"task_index": 0, "task": "cable-shape-notarget"}]
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["task"]
    described = pq.read_table(dataset / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    start = 0
    for number, (row, episode) in enumerate(zip(described, episodes, strict=True)):
        stop = start + episode.info.actions
        assert (row["episode_index"], row["length"]) == (number, stop - start)
        assert (row["dataset_from_index"], row["dataset_to_index"]) == (start, stop)
        assert row["tasks"] == ["cable-shape-notarget"]
        assert (row["data/chunk_index"], row["data/file_index"]) == (0, 0)
        start = stop


def test_lerobot_statistics_are_those_of_the_data(dataset: Path, episodes: list[Episode]) -> None:
    statistics = json.loads((dataset / "meta/stats.json").read_text())
    steps = [step for episode in episodes for step in episode.steps[:-1]]
    colors = np.stack([step.color for step in steps]) / 255
    heights = np.stack([step.height for step in steps])
    actions = np.stack([step.action for step in steps if step.action is not None])
    for key, values, axes, shape in (
        ("observation.images.color", colors, (0, 1, 2), (3, 1, 1)),
        ("observation.height", heights, (0, 1, 2), (1, 1)),
        ("action", actions, 0, (7,)),
    ):
        for name in ("min", "max", "mean", "std"):
            statistic = np.array(statistics[key][name])
            assert statistic.shape == shape
            expected = getattr(values, name)(axis=axes).reshape(shape)
            np.testing.assert_allclose(statistic, expected, atol=1e-6)
        assert statistics[key]["count"] == [len(steps)]
    row = pq.read_table(dataset / "meta/episodes/chunk-000/file-000.parquet").to_pylist()[2]
    own = np.stack([step.action for step in episodes[2].steps[:-1] if step.action is not None])
    np.testing.assert_allclose(row["stats/action/mean"], own.mean(axis=0), atol=1e-6)
    assert row["stats/action/count"] == [3]


@pytest.mark.parametrize("cuts", [(), (1,), (3, 7, 8)])
def test_running_statistics_do_not_depend_on_the_batches(cuts: tuple[int, ...]) -> None:
    rows = np.random.default_rng(0).normal(1e4, 1.0, (10, 2))
    running = RunningStatistics((2,))
    for part in np.split(rows, cuts):
        running.add(part, frames=len(part))
    statistics = running.as_lists()
    np.testing.assert_allclose(statistics["mean"], rows.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(statistics["std"], rows.std(axis=0), rtol=1e-9)
    assert (statistics["min"], statistics["max"]) == (
        rows.min(axis=0).tolist(),
        rows.max(axis=0).tolist(),
    )
    assert statistics["count"] == [10]


def test_lerobot_begins_new_files(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lerobot, "_FILE_MB", 0)
    monkeypatch.setattr(lerobot, "_FILES_A_CHUNK", 5)
    monkeypatch.setattr(lerobot, "_EPISODES_A_BATCH", 5)
    export_lerobot(source, tmp_path / "out")
    files = sorted((tmp_path / "out/data").glob("*/*.parquet"))
    assert [str(path.relative_to(tmp_path / "out/data")) for path in files] == [
        f"chunk-{i // 5:03d}/file-{i % 5:03d}.parquet" for i in range(COUNT)
    ]
    rows = pq.read_table(tmp_path / "out/meta/episodes/chunk-000/file-000.parquet").to_pylist()
    places = [(row["data/chunk_index"], row["data/file_index"]) for row in rows]
    assert places == [divmod(i, 5) for i in range(COUNT)]
    for row, path in zip(rows, files, strict=True):
        assert set(pq.read_table(path)["episode_index"].to_pylist()) == {row["episode_index"]}


def test_robomimic_holds_the_episodes(
    source: Path, episodes: list[Episode], tmp_path: Path
) -> None:
    export_robomimic(source, tmp_path / "demos.hdf5")
    with h5py.File(tmp_path / "demos.hdf5") as file:
        data = file["data"]
        assert data.attrs["total"] == sum(episode.info.actions for episode in episodes)
        environment = json.loads(data.attrs["env_args"])
        assert (environment["env_name"], environment["type"]) == (
            "WarpDeform/CableShapeNotarget-v2",
            2,
        )
        assert sorted(data) == sorted(f"demo_{i}" for i in range(COUNT))
        for i, episode in enumerate(episodes):
            demo, steps = data[f"demo_{i}"], episode.steps
            assert demo.attrs["num_samples"] == episode.info.actions
            assert json.loads(demo.attrs["info"])["seed"] == demo.attrs["seed"] == i
            actions = np.stack([step.action for step in steps if step.action is not None])
            np.testing.assert_array_equal(demo["actions"], actions)
            np.testing.assert_array_equal(demo["rewards"], np.diff([s.score for s in steps]))
            np.testing.assert_array_equal(demo["dones"], [0] * (len(actions) - 1) + [1])
            for seen, rows in ((demo["obs"], steps[:-1]), (demo["next_obs"], steps[1:])):
                assert episode.goal is not None
                for t, step in enumerate(rows):
                    np.testing.assert_array_equal(seen["color"][t], step.color)
                    np.testing.assert_array_equal(seen["height"][t, ..., 0], step.height)
                    np.testing.assert_array_equal(seen["ground_truth"][t], step.ground_truth)
                    np.testing.assert_array_equal(seen["goal_color"][t], episode.goal.color)
                    np.testing.assert_array_equal(
                        seen["goal_height"][t, ..., 0], episode.goal.height
                    )
            layout = json.loads(demo.attrs["state_layout"])
            assert list(layout) == list(STATE_PARTS)
            for t, step in enumerate(steps[:-1]):
                parts = np.split(
                    demo["states"][t], np.cumsum([np.prod(s) for s in layout.values()])[:-1]
                )
                for part, flat in zip(STATE_PARTS, parts, strict=True):
                    np.testing.assert_array_equal(flat.reshape(layout[part]), getattr(step, part))
        masks = {key: [name.decode() for name in file["mask"][key]] for key in file["mask"]}
        assert masks["valid"] == ["demo_9"]
        assert sorted(masks["train"] + masks["valid"]) == sorted(data)


@pytest.mark.parametrize(("count", "valid"), [(1, None), (2, [b"demo_1"]), (9, [b"demo_8"])])
def test_masks_of_few_demonstrations(tmp_path: Path, count: int, valid: list[bytes] | None) -> None:
    folder = collect(tmp_path / "source", *(make_episode(seed) for seed in range(count)))
    export_robomimic(folder, tmp_path / "demos.hdf5")
    with h5py.File(tmp_path / "demos.hdf5") as file:
        assert ("valid" in file["mask"]) == (valid is not None)
        if valid:
            assert file["mask/valid"][:].tolist() == valid


@pytest.mark.parametrize("kind", EXPORTS)
def test_what_is_not_there_is_left_out(tmp_path: Path, kind: str) -> None:
    """Episodes of a robot or of the original have no ground truth; some tasks have no goal."""
    episode = make_episode(actions=1)
    for t in range(2):
        episode = with_step(episode, t, ground_truth=np.zeros(0, np.float32))
    export, name = EXPORTS[kind]
    export(collect(tmp_path / "source", episode), tmp_path / name)
    if kind == "lerobot":
        names = pq.read_schema(tmp_path / "out/data/chunk-000/file-000.parquet").names
        assert not any("goal" in key or "truth" in key for key in names)
    else:
        with h5py.File(tmp_path / name) as file:
            assert sorted(file["data/demo_0/obs"]) == ["color", "height"]


@pytest.mark.parametrize("kind", EXPORTS)
@pytest.mark.parametrize(
    ("second", "expected"),
    [
        (make_episode(1, actions=0), "the episode of seed 1 has no action"),
        (with_info(make_episode(1, goal=True), seed=1), "task"),
        (make_episode(1, size=(8, 8)), "of seed 1 differs"),
    ],
)
def test_a_failed_export_leaves_nothing(
    tmp_path: Path, kind: str, second: Episode, expected: str
) -> None:
    folder = collect(tmp_path / "source", make_episode(0), second)
    export, name = EXPORTS[kind]
    with pytest.raises(InputError, match=expected):
        export(folder, tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == ["source"]


@pytest.mark.parametrize("kind", EXPORTS)
def test_nothing_is_overwritten(
    tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, (_, name) = collect(tmp_path / "source", make_episode(0)), EXPORTS[kind]
    target = tmp_path / "new" / name
    arguments = ["convert", str(folder), str(target), "--to", kind]
    assert main([*arguments, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["format"], report["episodes"], report["task"]) == (kind, 1, "cable-ring")
    assert report["bytes"] == conversion.size_of(target) > 1000
    assert main(arguments) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "exists already" in said
    assert [path.name for path in target.parent.iterdir()] == [name]


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        ([], "give either --to lerobot"),
        (["--to", "lerobot", "--from", "deformable-ravens"], "give either --to"),
        (["--to", "zarr"], "invalid choice 'zarr'"),
        (["--to", "lerobot", "--task", "cable-ring"], "go with --from"),
        (["--to", "lerobot"], "cannot be read as a folder of episodes"),
        (["--to", "robomimic"], "must end with .hdf5"),
        (["--from", "deformable-ravens"], "begins with no task"),
    ],
)
def test_bad_flags(
    tmp_path: Path, flags: list[str], expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["convert", str(tmp_path / "none"), str(tmp_path / "out"), *flags]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and expected in said
    assert list(tmp_path.iterdir()) == []


def test_robomimic_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(InputError, match=r"pip install -c constraints.txt -e '\.\[export\]'"):
        export_robomimic(tmp_path, tmp_path / "out.hdf5")


def test_a_destination_has_one_writer_and_no_foreign_files(tmp_path: Path) -> None:
    target, description = tmp_path / "out", {"a": 1}
    with new_folder(target, description=description) as folder:
        (folder / "file").write_text("whole")
        with (
            pytest.raises(InputError, match="another process"),
            new_folder(target, description=description),
        ):
            pass
    assert (target / "file").read_text() == "whole"
    assert [path.name for path in target.iterdir()] == ["file"]
    (tmp_path / ".other.partial").mkdir()
    (tmp_path / ".other.partial" / "mine").touch()
    with (
        pytest.raises(InputError, match="in the way"),
        new_folder(tmp_path / "other", description=description),
    ):
        pass
    assert (tmp_path / ".other.partial" / "mine").exists()
    (tmp_path / "file").touch()
    with (
        pytest.raises(InputError, match=r"cannot be made|exists already"),
        new_folder(tmp_path / "file" / "out", description=description),
    ):
        pass


@pytest.mark.parametrize(("resume", "same", "reused"), [(True, True, True), (True, False, False)])
def test_what_an_interrupted_run_left(
    tmp_path: Path, resume: bool, same: bool, reused: bool
) -> None:
    with (
        pytest.raises(KeyboardInterrupt),
        new_folder(tmp_path / "out", description={"a": 1}, resume=resume) as folder,
    ):
        (folder / "inner").mkdir()
        (folder / "inner" / "file").touch()
        raise KeyboardInterrupt
    assert not (tmp_path / "out").exists()
    description = {"a": 1 if same else 2}
    with new_folder(tmp_path / "out", description=description, resume=resume) as folder:
        assert (folder / "inner" / "file").exists() == reused
    assert os.listdir(tmp_path) == ["out"]
