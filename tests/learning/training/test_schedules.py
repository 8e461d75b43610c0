"""How long to train: the paper's numbers, snapshots, and one line for what cannot be."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from learning.policy.policy import AGENTS
from learning.training.config import TrainConfig
from learning.training.schedules import SCHEDULES, STATE_SCHEDULES, Schedule, preset_schedule
from learning.training.settings import AgentName
from warp_deform.errors import InputError


def test_presets_are_the_papers_and_ours() -> None:
    paper = SCHEDULES["paper"]
    assert (paper.steps, paper.batch, paper.lr, paper.snapshots) == (20_000, 1, 1e-4, 10)
    assert (paper.ema, paper.decay, paper.warmup) == (0.0, False, 0)
    assert SCHEDULES["fast"].snapshot_steps() == (300, 600, 1200, 2400, 4000)
    assert [STATE_SCHEDULES[name].place_lr for name in ("paper", "fast")] == [1.0, 5.0]
    assert [STATE_SCHEDULES[name].even for name in ("paper", "fast")] == [0.0, 0.5]


@pytest.mark.parametrize(
    ("task", "demos", "preset", "agent", "steps"),
    [
        ("bag-color-goal", 100, "paper", "goal-split", 40_000),
        ("bag-color-goal", 1000, "paper", "goal-split", 40_000),
        ("bag-color-goal", 10, "paper", "goal-split", 20_000),
        ("bag-color-goal", 100, "fast", "goal-split", 4000),
        ("bag-color-goal", 100, "paper", "gt-mlp", 20_000),
        ("bag-items-1", 1000, "paper", "transporter", 20_000),
    ],
)
def test_bags_by_color_train_for_longer(
    task: str, demos: int, preset: str, agent: AgentName, steps: int
) -> None:
    schedule = preset_schedule(preset, task=task, demos=demos, sees=AGENTS[agent].sees)
    assert schedule.steps == steps
    config = TrainConfig(
        task=task, agent=agent, data=Path("none"), out=Path("none"), demos=demos, preset=preset
    )
    assert config.plan(demos) == schedule
    if agent == "gt-mlp":
        assert schedule == STATE_SCHEDULES[preset]


def test_changes_to_the_preset_come_on_top(tmp_path: Path) -> None:
    config = TrainConfig(
        task="bag-color-goal", agent="goal-stack", data=tmp_path, out=tmp_path, lr=0.5
    )
    assert config.plan(99) == replace(SCHEDULES["paper"], lr=0.5)
    assert config.plan(100).steps == 40_000
    with pytest.raises(InputError, match="snapshots is 7; with steps = 6"):
        replace(config, steps=6, snapshots=7)


@settings(derandomize=True, deadline=None, max_examples=200)
@given(st.integers(1, 400).flatmap(lambda n: st.tuples(st.just(n), st.integers(n, 5000))))
def test_snapshots_are_as_many_as_asked_for_and_evenly_spread(numbers: tuple[int, int]) -> None:
    n, steps = numbers
    snapshots = Schedule(steps=steps, batch=1, lr=1.0, snapshots=n).snapshot_steps()
    assert len(set(snapshots)) == n and snapshots[-1] == steps and snapshots[0] >= 1
    assert all(abs(step - k * steps / n) <= 0.5 for k, step in enumerate(snapshots, start=1))


@settings(derandomize=True, deadline=None, max_examples=200)
@given(st.integers(1, 5000))
def test_snapshots_at_shares_come_after_these_parts_of_the_steps(steps: int) -> None:
    fast = replace(SCHEDULES["fast"], steps=steps)
    snapshots = fast.snapshot_steps()
    assert snapshots[-1] == steps and snapshots[0] >= 1
    assert list(snapshots) == sorted({each for s in fast.shares if (each := round(s * steps))})
    assert len(snapshots) == len(fast.shares) or steps < 20


def test_validation_is_the_presets_unless_nothing_can_be_played(tmp_path: Path) -> None:
    def plan(**changes: Any) -> Schedule:
        settings = {"task": "cable-ring", "agent": "transporter", "preset": "fast"} | changes
        return TrainConfig(data=tmp_path, out=tmp_path, **settings).plan(10)

    assert plan().validate == 20 and plan(agent="gt-mlp").validate == 20
    assert plan(preset="paper").validate == 0
    assert plan(validate=0).validate == 0 and plan(validate=7).validate == 7
    assert plan(hold_out=6).validate == 0 and plan(hold_out=6, validate=7).validate == 7
    assert plan(snapshots=4).snapshot_steps() == (1000, 2000, 3000, 4000), "as asked for"
    assert plan(steps=10).snapshot_steps() == (1, 2, 3, 6, 10)
    assert plan(steps=2).snapshot_steps() == (1, 2)


def test_patience_is_the_presets_unless_nothing_is_played(tmp_path: Path) -> None:
    def patience(**changes: Any) -> int | None:
        settings = {"task": "cable-ring", "agent": "transporter", "preset": "fast"} | changes
        return TrainConfig(data=tmp_path, out=tmp_path, **settings).plan(10).patience

    assert patience() == 2 and patience(patience=5) == 5
    assert patience(patience=0) is None, "switched off"
    assert patience(validate=0) is None and patience(hold_out=3) is None
    assert patience(preset="paper") is None and patience(agent="gt-mlp") is None
    assert patience(preset="paper", validate=3, patience=1) == 1


def test_what_confirms_is_the_presets_unless_nothing_is_played(tmp_path: Path) -> None:
    def confirm(**changes: Any) -> int:
        settings = {"task": "cable-ring", "agent": "transporter", "preset": "fast"} | changes
        return TrainConfig(data=tmp_path, out=tmp_path, **settings).plan(10).confirm

    assert confirm() == 40 and confirm(agent="gt-mlp") == 40 and confirm(validate=7) == 40
    assert confirm(confirm=3) == 3 and confirm(confirm=0) == 0
    assert confirm(validate=0) == 0 and confirm(hold_out=3) == 0 and confirm(preset="paper") == 0
    assert confirm(preset="paper", validate=3, confirm=2) == 2


@pytest.mark.parametrize("shares", [(0.5,), (0.0, 1.0), (0.5, 1.5)])
def test_shares_end_with_the_last_step(shares: tuple[float, ...]) -> None:
    with pytest.raises(InputError, match="shares are"):
        Schedule(steps=4, batch=1, lr=1.0, shares=shares)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"steps": 0}, "steps is 0; it must be 1 or more"),
        ({"batch": -2}, "batch is -2; it must be 1 or more"),
        ({"snapshots": 0}, "snapshots is 0; it must be 1 or more"),
        ({"snapshots": 9}, "snapshots is 9; with steps = 4 it must be 1 to 4"),
        ({"warmup": -1}, "warmup is -1; it must be 0 or more"),
        ({"lr": 0.0}, "lr is 0.0; it must be a positive number"),
        ({"lr": float("nan")}, "lr is nan; it must be a positive number"),
        ({"place_lr": 0.0}, "place_lr is 0.0; it must be a positive number"),
        ({"even": 1.5}, "even is 1.5; it must be from 0 to 1"),
        ({"ema": 1.0}, "ema is 1.0; it must be 0 or more and less than 1"),
    ],
)
def test_what_is_out_of_range_is_named(changes: dict[str, Any], message: str) -> None:
    values: dict[str, Any] = {"steps": 4, "batch": 1, "lr": 1e-3, "snapshots": 2} | changes
    with pytest.raises(InputError) as caught:
        Schedule(**values)
    assert str(caught.value) == message


def test_gaussians_weigh_the_same_at_first_unless_they_learnt_or_the_original_has_it_otherwise(
    tmp_path: Path,
) -> None:
    def even(**changes: Any) -> float:
        settings = {"task": "cable-ring", "agent": "gt-mlp", "preset": "fast"} | changes
        return TrainConfig(data=tmp_path, out=tmp_path, **settings).plan(10).even

    assert even() == 0.5 and even(steps=10) == 0.5
    assert even(exact=True) == 0 and even(start=tmp_path) == 0 and even(preset="paper") == 0
    asked = replace(STATE_SCHEDULES["fast"], even=0.25)
    assert even(schedule=asked) == even(schedule=asked, start=tmp_path) == 0.25, "as asked for"
