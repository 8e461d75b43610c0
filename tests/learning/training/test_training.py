"""Training: the same bits twice, what agents come to, and one line for what cannot be."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fixtures.episode_samples import with_step
from fixtures.training_samples import block_episode, write_demonstrations

from learning.data.augmentation import RigidTransform, draw_transforms
from learning.data.batches import check_lifts, state_batch
from learning.data.dataset import Demonstrations
from learning.policy.policy import ImagePolicy, RetryingPolicy, StatePolicy, load_policy
from learning.runs.folder import RunFolder, read_snapshot
from learning.training.config import TrainConfig
from learning.training.schedules import Schedule
from learning.training.train import TrainReport, train
from warp_deform.command.main import main
from warp_deform.episodes import Episode, EpisodeWriter
from warp_deform.errors import InputError
from warp_deform.tasks.cable_line import CableLineNotarget

TASK = "cable-line-notarget"
pytestmark = pytest.mark.usefixtures("narrow_networks")
HALF = ["--precision", "bfloat16"]
SHORT = Schedule(steps=4, batch=1, lr=1e-3, warmup=2, decay=True, ema=0.9, snapshots=2)
STATES = replace(SHORT, steps=60, batch=16, lr=3e-3)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_demonstrations(tmp_path_factory.mktemp("data") / "demos", 4)


def config(folder: Path, out: Path, **changes: Any) -> TrainConfig:
    values = {"agent": "goal-stack", "preset": "fast", "schedule": SHORT, "demos": 3} | changes
    return TrainConfig(task=TASK, data=folder, out=out, **values)


@pytest.fixture(scope="module")
def straight(
    narrow_networks: None, folder: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, TrainReport]:
    out = tmp_path_factory.mktemp("run") / "straight"
    return out, train(config(folder, out))


def test_the_same_command_gives_the_same_bits(
    folder: Path, straight: tuple[Path, TrainReport], tmp_path: Path
) -> None:
    out, report = straight
    again = train(config(folder, tmp_path))
    assert again.weights_hash == report.weights_hash
    assert report.snapshots == (2, 4) and report.steps == 4
    modes = {path.stat().st_mode for path in out.rglob("*.*") if path.is_file()}
    assert len(modes) == 1, "whoever may read one file may read all"
    for step in report.snapshots:
        files = [RunFolder(run).snapshot(step).read_bytes() for run in (out, tmp_path)]
        assert files[0] == files[1]
    other = train(config(folder, tmp_path / "other", seed=1))
    assert other.weights_hash != report.weights_hash


def test_a_folder_with_another_run_is_refused(
    folder: Path, straight: tuple[Path, TrainReport]
) -> None:
    with pytest.raises(InputError, match="holds a run with another seed"):
        train(config(folder, straight[0], seed=3))


@pytest.mark.parametrize("agent", ["gt-mlp", "gt-mlp-2step"])
def test_a_baseline_learns_and_its_log_shows_it(agent: str, folder: Path, tmp_path: Path) -> None:
    schedule = replace(STATES, steps=300)
    report = train(config(folder, tmp_path, agent=agent, schedule=schedule))
    lines = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [50, 100, 150, 200, 250, 300]
    assert lines[-1]["loss"] == report.loss
    assert lines[-1]["loss"] < lines[0]["loss"] - 1.0
    policy = load_policy(tmp_path)
    assert isinstance(policy, StatePolicy)
    seen = {"ground_truth": np.zeros(144, np.float32)}
    actions = [policy.act(seen, rng=np.random.default_rng(k)) for k in (0, 0, 1)]
    assert actions[0].shape == (7,) and (actions[0] == actions[1]).all()
    assert (actions[0] != actions[2]).any()
    with pytest.raises(InputError, match="hand in a generator"):
        policy.act(seen)
    with pytest.raises(InputError, match="`ground_truth` of 144 numbers"):
        policy.act({}, rng=np.random.default_rng(0))


def test_a_policy_acts_on_what_the_environment_shows(
    folder: Path, straight: tuple[Path, TrainReport]
) -> None:
    policy = load_policy(straight[0])
    rng = np.random.default_rng(0)
    color = rng.integers(0, 255, (320, 160, 3), dtype=np.uint8)
    height = rng.random((320, 160), dtype=np.float32) * 0.05
    seen = {"color": color, "height": height, "goal_color": color[::-1], "goal_height": height}
    action = policy.act(seen)
    assert action.shape == (7,) and action[6] == 0.04 and action[2] == 0.0
    assert (0.25 <= action[[0, 3]]).all() and (action[[0, 3]] <= 0.75).all()
    goal = {"color": color[::-1], "height": height}
    given = policy.act({"color": color, "height": height}, goal)
    assert (given == action).all()
    with pytest.raises(InputError, match="no 'goal_color'"):
        policy.act({"color": color, "height": height})
    with pytest.raises(InputError, match="height: shape"):
        policy.act({**seen, "height": height.astype(float)})


def test_a_retrying_policy_picks_elsewhere_until_something_changes(
    straight: tuple[Path, TrainReport],
) -> None:
    policy = load_policy(straight[0])
    assert isinstance(policy, ImagePolicy)
    retrying = RetryingPolicy(policy)
    color = np.random.default_rng(0).integers(0, 255, (320, 160, 3), dtype=np.uint8)
    height = np.zeros((320, 160), np.float32)
    seen = {"color": color, "height": height, "goal_color": color, "goal_height": height}
    picks = [retrying.act(seen)[:2] for _ in range(5)]
    assert (picks[0] == policy.act(seen)[:2]).all()
    gaps = [np.linalg.norm(a - b) for i, a in enumerate(picks) for b in picks[:i]]
    assert min(gaps) >= 0.008
    moved = {**seen, "color": np.roll(color, 7, axis=0)}
    last = retrying.act(seen)[3:5]
    again = retrying.act(moved)[:2]
    assert (again == policy.act(moved, avoid=[(last, 0.02)])[:2]).all()
    noisy = {**moved, "color": np.clip(moved["color"].astype(int) + 5, 0, 255).astype(np.uint8)}
    assert np.linalg.norm(retrying.act(noisy)[:2] - policy.act(moved)[:2]) >= 0.008
    retrying.reset()
    assert (retrying.act(seen) == policy.act(seen)).all()


def test_snapshots_hold_averaged_weights(folder: Path, tmp_path: Path) -> None:
    plain = replace(SHORT, ema=0.0)
    train(config(folder, tmp_path, schedule=plain))
    run = RunFolder(tmp_path)
    weights = read_snapshot(run.snapshot(4))[0]
    state = run.read_state()[0]
    assert all(torch.equal(each, state[f"weights.{name}"]) for name, each in weights.items())


@pytest.mark.parametrize(
    ("agent", "flags", "expected"),
    [
        (
            "goal-stack",
            ["--precision", "bfloat16", "--no-augment"],
            {"exact": False, "bfloat16": True},
        ),
        ("goal-stack", ["--exact"], {"exact": True, "bfloat16": False}),
        ("gt-mlp", ["--exact"], {"exact": True, "cosines_less_one": False}),
        ("gt-mlp-2step", [], {"exact": False, "cosines_less_one": True}),
    ],
)
def test_switches_reach_the_agent(
    agent: str, flags: list[str], expected: dict[str, bool], folder: Path, tmp_path: Path
) -> None:
    command = ["train", TASK, "--agent", agent, "--data", str(folder), "--out", str(tmp_path)]
    schedule = ["--preset", "fast", "--steps", "1", "--snapshots", "1", "--validate", "0"]
    assert main([*command, *schedule, *flags]) == 0
    settings = RunFolder(tmp_path).read_settings()
    made = load_policy(tmp_path).description.config
    assert {name: made[name] for name in expected} == expected
    assert settings["augment"] is ("--no-augment" not in flags)
    assert ("even" in settings["schedule"]) is made.get("cosines_less_one", False)
    policy = load_policy(tmp_path)
    if isinstance(policy, ImagePolicy):
        attention = policy.agent.attention
        assert (attention.exact, attention.network.bfloat16) == tuple(expected.values())


def test_without_augmentation_nothing_is_moved(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*_: Any, **__: Any) -> None:
        raise AssertionError

    monkeypatch.setattr("learning.data.batches.draw_transform", never)
    monkeypatch.setattr("learning.data.batches.draw_transforms", never)
    for agent in "goal-stack", "gt-mlp":
        out = tmp_path / agent
        one = replace(SHORT, steps=1, snapshots=1)
        train(config(folder, out, agent=agent, schedule=one, augment=False))
        with pytest.raises(AssertionError):
            train(config(folder, tmp_path / f"{agent}-moved", agent=agent, schedule=one))


def test_what_a_baseline_sees_may_leave_the_table(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept: list[bool] = []

    def noted(*given: Any, in_view: bool = True, **more: Any) -> list[RigidTransform]:
        kept.append(in_view)
        return draw_transforms(*given, in_view=in_view, **more)

    monkeypatch.setattr("learning.data.batches.draw_transforms", noted)
    one = replace(SHORT, steps=1, snapshots=1)
    train(config(folder, tmp_path, agent="gt-mlp", schedule=one))
    settings = RunFolder(tmp_path).read_settings()
    assert kept and not any(kept) and settings["in_view"] is False
    assert not {"place_lr", "even"} & settings["schedule"].keys(), "named where chosen"


def lifted(lift: float) -> Episode:
    """An episode whose second action is carried at a height [m]; the stage's is 0.04 m."""
    made = block_episode(1)
    return with_step(made, 1, action=np.array([*made.steps[1].action[:6], lift]))


def test_a_lift_of_no_stage_is_refused(tmp_path: Path) -> None:
    writer = EpisodeWriter(tmp_path / "data")
    writer.write(block_episode(0))
    writer.write(lifted(0.12))
    with pytest.raises(InputError) as caught:
        train(TrainConfig(task=TASK, agent="gt-mlp", data=tmp_path / "data", out=tmp_path / "run"))
    said = str(caught.value)
    assert "episode_000000001.parquet lifts to 0.12 m" in said and "stages lift to 0.04 m" in said
    assert not (tmp_path / "run").exists(), "before anything is trained"


def out_of_view() -> Episode:
    """An episode whose second action picks beyond the picture."""
    made = block_episode(1)
    return with_step(made, 1, action=np.array([0.9, *made.steps[1].action[1:]]))


@pytest.mark.parametrize(
    ("agent", "changes", "said"),
    [
        ("gt-mlp", {}, "ground_truth_rows of its task, cannot be moved; train with --no-augment"),
        ("goal-stack", {"augment": False}, r"episode_000000001\.parquet acts out of view"),
        ("goal-stack", {"demos": 1, "hold_out": 1}, r"000001\.parquet acts out of view"),
        ("gt-mlp", {"augment": False, "tensorboard": True}, "TensorBoard is not installed"),
    ],
)
def test_a_refused_training_leaves_no_run(
    agent: str, changes: dict[str, Any], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A report would list it, and the same command, mended, would meet another run's folder."""
    monkeypatch.setattr(CableLineNotarget, "ground_truth_rows", ())
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    writer = EpisodeWriter(tmp_path / "data")
    for episode in (block_episode(0), out_of_view()):
        writer.write(episode)
    wanted = config(tmp_path / "data", tmp_path / "run", agent=agent, **{"demos": 2, **changes})
    with pytest.raises(InputError, match=said):
        train(wanted)
    assert not (tmp_path / "run").exists()


def test_a_lift_that_a_robot_makes_of_a_stage_s_is_taken(tmp_path: Path) -> None:
    EpisodeWriter(tmp_path).write(lifted(0.05))
    data = Demonstrations(tmp_path, task=TASK)
    check_lifts(data)
    assert (
        state_batch(data, (0.04,), transitions=[(0, 0)] * 8, rng=np.random.default_rng(0))[
            2
        ].tolist()
        == [0] * 8
    )
    with pytest.raises(InputError, match=r"lifts to 0\.0[45] m"):
        state_batch(data, (0.1, 0.3), transitions=[(0, 0)], rng=np.random.default_rng(0))


def test_damaged_and_foreign_snapshots_are_refused(
    straight: tuple[Path, TrainReport], tmp_path: Path
) -> None:
    source = RunFolder(straight[0]).snapshot(4)
    weights, record = source.read_bytes(), source.with_suffix(".json").read_text()

    def refused(data: bytes, text: str, match: str) -> None:
        (tmp_path / "step_00000004.safetensors").write_bytes(data)
        (tmp_path / "step_00000004.json").write_text(text)
        with pytest.raises(InputError, match=match):
            load_policy(tmp_path / "step_00000004.safetensors")

    refused(weights[:1000], record, "damaged or no safetensors")
    refused(weights, "{", "cannot be read as JSON")
    refused(weights, record.replace('"format": 1', '"format": 2'), "has format 2")
    refused(weights, record.replace("goal-stack", "goal-split"), "no snapshot of this release")
    refused(weights, record.replace('"width"', '"girth"'), "no setting 'girth'")
    with pytest.raises(InputError, match="there is no snapshot"):
        load_policy(tmp_path / "step_00000009.safetensors")
    with pytest.raises(InputError, match="holds no training run"):
        load_policy(tmp_path)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"agent": "transporter"}, "does not see; use --agent goal-split"),
        ({"agent": "resnet"}, "there is no agent"),
        ({"preset": "slow"}, "preset is 'slow'"),
        ({"seed": -1}, "seed is -1; it must be 0 or more"),
        ({"threads": 0}, "threads is 0; it must be 1 or more"),
        ({"validate": -3}, "validate is -3; it must be 0 or more"),
        ({"patience": 2}, "patience is 2 and validate 0; .* needs validation episodes, 1 or more"),
        ({"confirm": 2}, "confirm is 2 and validate 0; there is nothing to confirm"),
        ({"confirm": -1, "validate": 1}, "confirm is -1; it must be 0 or more"),
        ({"patience": -1, "validate": 1}, "patience is -1; it must be 0 or more"),
        ({"precision": "half"}, "precision is 'half'; it must be one of"),
        ({"device": "tpu"}, "device is 'tpu'; it must be 'cpu' or 'cuda'"),
        (
            {"agent": "gt-mlp", "precision": "float32"},
            "precision is for agents over pictures; gt-mlp has its own",
        ),
        (
            {"exact": True, "precision": "bfloat16"},
            "bfloat16 and exact exclude each other",
        ),
    ],
)
def test_bad_settings(folder: Path, tmp_path: Path, changes: dict[str, Any], match: str) -> None:
    with pytest.raises(InputError, match=match):
        train(config(folder, tmp_path, **changes))


def test_a_goal_agent_needs_a_goal(tmp_path: Path) -> None:
    write_demonstrations(tmp_path, 1, task="cable-ring")
    with pytest.raises(InputError, match="cable-ring has none; use --agent transporter"):
        train(
            TrainConfig(
                task="cable-ring",
                agent="goal-split",
                data=tmp_path,
                out=tmp_path / "run",
                preset="fast",
                schedule=SHORT,
            )
        )


@pytest.mark.parametrize(
    "arguments",
    [
        ["train", "cable-line", "--agent", "gt-mlp", "--data", "x", "--out", "y"],
        ["train", TASK, "--agent", "gt-mlp", "--data", "missing", "--out", "y"],
        ["train", TASK, "--agent", "dqn", "--data", "x", "--out", "y"],
        ["eval", "missing"],
        ["eval", "missing", "--workers", "0"],
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    arguments: list[str],
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    assert out == "" and len(err.splitlines()) == 1


def test_place_yaws_are_chosen_where_they_matter(
    folder: Path, straight: tuple[Path, TrainReport], tmp_path: Path
) -> None:
    block = write_demonstrations(tmp_path / "block", 1, task="block-notarget", actions=1)
    one = Schedule(steps=1, batch=1, lr=1e-3, snapshots=1)
    settings = {"task": "block-notarget", "preset": "fast", "schedule": one, "data": block}
    for agent in "goal-stack", "gt-mlp":
        train(TrainConfig(agent=agent, out=tmp_path / agent, **settings))
    images = load_policy(tmp_path / "goal-stack").description.config
    assert (images["n_rotations_train"], images["n_rotations_eval"]) == (24, 24)
    seen = load_policy(tmp_path / "gt-mlp").agent.config
    assert (seen.one_rotation, seen.yaws) == (False, (2, 5))
    elsewhere = load_policy(straight[0]).description.config
    assert (elsewhere["n_rotations_train"], elsewhere["n_rotations_eval"]) == (1, 1)
