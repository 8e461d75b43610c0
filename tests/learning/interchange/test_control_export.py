"""Control at 20 Hz as a LeRobotDataset: columns, names, quantiles, and a card."""

from __future__ import annotations

import dataclasses
import itertools
import json
from pathlib import Path

import cv2
import gymnasium
import numpy as np
import pyarrow.parquet as pq
import pytest
from fixtures.episode_samples import make_episode

import warp_deform  # noqa: F401  (registers the ids)
from learning.interchange.lerobot import export_lerobot
from learning.interchange.running_statistics import QUANTILES, RunningStatistics
from warp_deform.collecting.collect import CollectConfig, collect
from warp_deform.control.numbers import recorded_numbers
from warp_deform.episodes import EpisodeReader, EpisodeWriter
from warp_deform.errors import InputError

SENTENCE = "Move the block to where the goal picture shows it."
POSE = ["dx", "dy", "dz", "dyaw", "hold"]


@pytest.fixture(scope="module", params=[False, True], ids=["numbers", "pictures"])
def exported(request, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, bool]:
    """Two demonstrations of a block, whose goal is a picture, and their export."""
    root = tmp_path_factory.mktemp("control")
    collect(
        CollectConfig(
            task="block-notarget", episodes=2, seed=6, out=root / "demos", workers=1,
            control=True, pictures=request.param,
        )
    )  # fmt: skip
    export_lerobot(root / "demos", root / "out")
    return root / "demos", root / "out", request.param


def frames(out: Path) -> list[dict]:
    return pq.read_table(out / "data/chunk-000/file-000.parquet").to_pylist()


def test_frames_are_observation_and_action_of_one_instant(exported) -> None:
    demos, out, pictures = exported
    rows, index = frames(out), 0
    for number, episode in enumerate(EpisodeReader(demos, control=True)):
        numbers = recorded_numbers(episode)
        for t, step in enumerate(episode.steps[:-1]):
            row, after = rows[index], episode.steps[t + 1]
            assert step.control is not None and after.control is not None
            state = np.append(step.control.tip, step.control.holding).astype(np.float32)
            assert np.array_equal(np.float32(row["observation.state"]), state)
            assert np.array_equal(row["action"], step.action), "float32 holds all of an action"
            assert row["next.reward"] == np.float32(after.control.reward)
            assert row["next.success"] == after.success
            assert row["next.done"] == (t == episode.info.actions - 1)
            assert abs(row["timestamp"] - t / 20) < 1e-6
            assert (row["episode_index"], row["frame_index"]) == (number, t)
            if pictures:
                data = np.frombuffer(row["observation.images.top"]["bytes"], np.uint8)
                seen = cv2.imdecode(data, cv2.IMREAD_COLOR)[:, :, ::-1]
                assert np.array_equal(seen, step.color)
            else:
                truth = np.float32(row["observation.environment_state"])
                assert np.array_equal(truth, numbers[t])
            index += 1
    assert index == len(rows)


def test_only_what_a_policy_may_see_is_called_observation(exported) -> None:
    _, out, pictures = exported
    info = json.loads((out / "meta/info.json").read_text())
    seen = {name for name in info["features"] if name.startswith("observation")}
    camera = {"observation.images.top", "observation.images.goal"}
    assert seen == {
        "observation.state",
        *(camera if pictures else {"observation.environment_state"}),
    }
    assert [name for name in info["features"] if name.startswith("action")] == ["action"]
    assert (info["fps"], info["robot_type"], info["total_episodes"]) == (20, "ur5", 2)
    assert info["features"]["action"] == {"dtype": "float32", "shape": [5], "names": POSE}
    assert info["features"]["observation.state"]["names"] == [
        "tip_x", "tip_y", "tip_z", "tip_yaw", "holding"
    ]  # fmt: skip
    tasks = pq.read_table(out / "meta/tasks.parquet").to_pylist()
    assert tasks == [
        {"task_index": 0, "task": "Move the block to where the goal picture shows it."}
    ]
    card = (out / "README.md").read_text()
    assert "dx, dy, dz, dyaw, hold" in card and ("sees the truth" in card) != pictures


def test_statistics_have_the_quantiles_that_policies_normalise_by(exported) -> None:
    demos, out, pictures = exported
    statistics = json.loads((out / "meta/stats.json").read_text())
    info = json.loads((out / "meta/info.json").read_text())
    assert statistics.keys() == info["features"].keys()
    for each in statistics.values():
        assert each.keys() == {"min", "max", "mean", "std", "count", *QUANTILES}
        below = [np.array(each[name]) for name in ("min", *QUANTILES, "max")]
        assert all((a <= b + 1e-6).all() for a, b in itertools.pairwise(below))
    actions = [step.action for e in EpisodeReader(demos, control=True) for step in e.steps[:-1]]
    for name, share in QUANTILES.items():
        np.testing.assert_allclose(
            statistics["action"][name], np.quantile(actions, share, axis=0), atol=1e-6
        )
    if pictures:
        colors = np.stack(
            [s.color for e in EpisodeReader(demos, control=True) for s in e.steps[:-1]]
        )
        levels = np.quantile(colors.reshape(-1, 3), 0.99, axis=0, method="inverted_cdf") / 255
        top = statistics["observation.images.top"]
        np.testing.assert_allclose(np.ravel(top["q99"]), levels, atol=1e-9)
    row = pq.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pylist()[0]
    assert len(row["stats/action/q50"]) == 5 and row["tasks"] == [SENTENCE]


def test_exported_actions_repeat_the_environment(exported) -> None:
    demos, out, _ = exported
    env = gymnasium.make("WarpDeform/BlockNotarget-Control-v1", control_mode="tip_delta_pose")
    episode = EpisodeReader(demos, control=True).read(6)
    numbers = recorded_numbers(episode)
    seen, info = env.reset(seed=6)
    for t, row in enumerate(frames(out)[: episode.info.actions]):
        assert np.array_equal(seen, numbers[t]), "what is read back is what the environment shows"
        seen, _, terminated, _, info = env.step(np.array(row["action"], np.float32))
    assert terminated and info["state_hash"] == episode.steps[-1].state_hash


def test_one_dataset_is_of_one_task_and_one_way_to_lead(exported, tmp_path: Path) -> None:
    demos, _, _ = exported
    mixed = tmp_path / "mixed"
    first = EpisodeReader(demos, control=True).read(6)
    EpisodeWriter(mixed).write(first)
    EpisodeWriter(mixed).write(make_episode(9))
    with pytest.raises(InputError, match="seed 9 differs"):
        export_lerobot(mixed, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    slower = dict(first.info.extra["control"], rate=12.5)
    info = dataclasses.replace(first.info, extra={"control": slower})
    EpisodeWriter(tmp_path / "slow").write(dataclasses.replace(first, info=info))
    with pytest.raises(InputError, match="whole frames a second"):
        export_lerobot(tmp_path / "slow", tmp_path / "out")


def test_quantiles_of_batches_are_those_of_all_rows() -> None:
    rows = np.random.default_rng(0).normal(size=(100, 2)).astype(np.float32)
    running = RunningStatistics((2,), quantiles=True)
    for part in np.split(rows, (3, 60)):
        running.add(part, frames=len(part))
    np.testing.assert_allclose(running.as_lists()["q10"], np.quantile(rows, 0.1, axis=0))
