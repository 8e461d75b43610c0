"""From nothing to a tested policy by one call: the plan is kept, parts come to the same bits."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
from fixtures.short_runs import said

from learning.distillation import distill as distilling
from learning.distillation.distill import DistillConfig, distill
from learning.distillation.plan import Costs, Plan, make_plan, read_plan
from learning.distillation.stages import Stages
from learning.runs.folder import RunFolder
from warp_deform.command.main import main
from warp_deform.episodes import EpisodeReader
from warp_deform.errors import InputError
from warp_deform.tasks.task import Task

TASK = "block-notarget"
PLAN = Plan(demos=2, round_steps=(1, 1), round_episodes=(1, 1), last_steps=2, snapshots=2,
            validation=1)  # fmt: skip
COSTS = Costs(start=30, demonstration=0.4, action=0.08, step=0.28)


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file with a plan that takes seconds."""
    path = tmp_path_factory.mktemp("plan") / "plan.json"
    path.write_text(json.dumps({"plan": asdict(PLAN)}))
    return path


@pytest.fixture(scope="module")
def whole(
    narrow_networks: None, plan: Path, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Any]:
    """What came of a distillation that nothing interrupted."""
    out = tmp_path_factory.mktemp("whole") / "out"
    return distill(DistillConfig(task=TASK, plan=plan, episodes=1, out=out))


def test_every_round_learns_from_all_before_it(whole: dict[str, Any]) -> None:
    stages = {each["stage"]: each for each in whole["stages"]}
    assert list(stages) == ["2 demonstrations", "training 1", "correction 1", "training 2",
                            "correction 2", "last training", "test"]  # fmt: skip
    trainings = [stages[name] for name in ("training 1", "training 2", "last training")]
    assert [each["demos"] for each in trainings] == [2, 3, 4]
    assert [each["corrected"] for each in trainings] == [0, 1, 2]
    labels = [stages[f"correction {n}"]["labels"] for n in (1, 2)]
    assert trainings[2]["labels"] == trainings[0]["labels"] + sum(labels) == whole["labels"]
    assert len({each["weights_hash"] for each in trainings}) == 3
    assert (whole["demos"], whole["corrected"], whole["agent"]) == (2, 2, "goal-split")
    run = RunFolder(Path(whole["run"]))
    assert run.steps() == [1, 2] and whole["selected"] in (1, 2)
    assert run.read_settings()["demonstrators"] == ["corrected by mpc", "mpc"]
    seeds = EpisodeReader(run.path.parent / "rounds" / "2" / "corrected").seeds
    assert len(seeds) == 4 and max(seeds) < 100
    assert not list(run.path.parent.rglob("rows"))  # caches would outweigh all else
    assert whole["test"]["n_episodes"] == 1
    spent = sum(each["cpu_seconds"] for each in whole["stages"] if each["stage"] != "test")
    assert whole["cpu_minutes"] == pytest.approx(spent / 60)
    assert whole["test_cpu_minutes"] == pytest.approx(stages["test"]["cpu_seconds"] / 60)


def test_where_a_start_s_own_goal_would_show_too_much_goals_are_made(
    narrow_networks: None, plan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Task, "goal_shows_its_start", lambda task: True)
    monkeypatch.setattr(distilling, "_GOALS", 2)
    report = distill(
        DistillConfig(task=TASK, plan=plan, episodes=1, out=tmp_path / "out", progress=False)
    )
    assert report["stages"][0]["stage"] == "goals"
    settings = RunFolder(Path(report["run"])).read_settings()
    assert (settings["goal"], settings["given_goals"]) == ("own", 4)
    assert settings["goal_seeds"] == [200_000, 200_001]
    learnt = EpisodeReader(tmp_path / "out" / "rounds" / "2" / "corrected")
    seeds = {info.seed: info.goal and info.goal["seed"] for info in learnt.infos()}
    assert len(seeds) == 4 and all(seeds[k] == 200_000 + k % 2 for k in seeds)


def test_an_interruption_loses_no_bit(
    whole: dict[str, Any], plan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = DistillConfig(task=TASK, plan=plan, episodes=1, out=tmp_path / "out", progress=False)

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    for name in ("_corrected", "_test"):
        with monkeypatch.context() as patch:
            patch.setattr(distilling, name, stop)
            with pytest.raises(KeyboardInterrupt):
                distill(config)
    again = distill(config)
    without = [
        [{k: v for k, v in each.items() if k != "cpu_seconds"} for each in report["stages"]]
        for report in (whole, again)
    ]
    assert without[0] == without[1]
    assert distill(config) == again  # nothing is done again, and nothing spent
    with pytest.raises(InputError, match="another seed"):
        distill(replace(config, seed=1))


def test_a_budget_is_measured_first_and_its_plan_kept(
    plan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []

    def work(self: Stages, name: str, _: object, *, what: str) -> dict[str, Any]:
        done.append(name)
        self.cost[name] = 8.0
        self.done[name] = {"step": 0.25, "actions": int(name.split()[0]) * 4} if name != "timing" \
            else {"step": 0.25}  # fmt: skip
        return self.done[name]

    def learn(config: DistillConfig, plan: Plan, *_: object) -> Path:
        planned.append(plan)
        raise KeyboardInterrupt

    planned: list[Plan] = []
    monkeypatch.setattr(Stages, "__call__", work)
    monkeypatch.setattr(distilling, "_learn", learn)
    config = DistillConfig(task="cable-ring", minutes=60, out=tmp_path / "out")
    with pytest.raises(KeyboardInterrupt):
        distill(config)
    assert done == ["2 demonstrations", "10 demonstrations", "timing", "40 demonstrations"]
    costs = json.loads((tmp_path / "out" / "distill.json").read_text())["costs"]
    assert costs == {"start": 24.0, "demonstration": 1.0, "action": 0.25, "step": 0.25}
    assert planned == [make_plan(60, Costs(**costs), max_actions=20)]
    assert read_plan(tmp_path / "out" / "distill.json") == planned[0]
    monkeypatch.setattr(distilling, "_measure", None)  # would not be called again
    with pytest.raises(KeyboardInterrupt):
        distill(config)
    assert planned[1] == planned[0]


@pytest.mark.parametrize("minutes", [5, 15, 60, 240])
@pytest.mark.parametrize("step", [0.05, 0.3])
def test_a_plan_keeps_within_its_budget(minutes: float, step: float) -> None:
    costs = replace(COSTS, step=step)
    plan = make_plan(minutes, costs, max_actions=20)
    played = 12 * (0.8 * step + costs.action)
    spent = costs.start + (plan.demos - 10) * costs.demonstration
    spent += (sum(plan.round_steps) + plan.last_steps) * step
    spent += sum(plan.round_episodes) * (played + 12 * costs.action)
    spent += plan.snapshots * plan.validation * played
    assert 0.85 * 60 * minutes < spent < 60 * minutes


def test_small_budgets_choose_no_snapshot_by_luck() -> None:
    small, large = (make_plan(m, COSTS, max_actions=20) for m in (10, 60))
    assert small.snapshots == 1 and large.snapshots > 1 and large.validation >= 15
    assert len(small.round_steps) < len(large.round_steps)
    with pytest.raises(InputError, match="minutes 0.6 is too little".replace(".", r"\.")):
        make_plan(0.6, COSTS, max_actions=20)


def test_refining_is_for_scripted_teachers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Stages, "__call__", lambda self, name, _, *, what: seen.append(name))
    stages = Stages(tmp_path / "stages.jsonl", told="")
    for teacher, rule, wanted in (
        ("mpc", "auto", False),
        ("scripted", "auto", True),
        ("scripted", "never", False),
        ("mpc", "always", True),
    ):
        seen: list[str] = []
        config = DistillConfig(task=TASK, teacher=teacher, refine=rule, out=tmp_path)
        folder = distilling._demonstrate(config, tmp_path, stages, 3)
        assert seen == ["3 demonstrations", *["refining 3"] * wanted]
        assert folder.name == ("refined-3" if wanted else "demos")


def test_a_stage_is_done_once_and_what_was_lost_is_counted(tmp_path: Path) -> None:
    file, calls = tmp_path / "stages.jsonl", []

    def work(result: dict[str, Any] | None) -> Any:
        calls.append(result)
        sum(range(300_000))
        if result is None:
            raise KeyboardInterrupt
        return result

    stages = Stages(file, told="")
    with pytest.raises(KeyboardInterrupt):
        stages("a", lambda: work(None), what="")
    lost = stages.cost["a"]
    assert lost > 0 and not stages.done
    with file.open("a") as torn:
        torn.write('{"stage": "a", "cpu_sec')
    stages = Stages(file, told="")
    assert stages("a", lambda: work({"x": 1}), what="") == {"x": 1}
    again = Stages(file, told="")
    assert again("a", lambda: work({"x": 2}), what="") == {"x": 1}
    assert len(calls) == 2 and again.cost["a"] > lost


def test_bad_input_is_one_line_and_leaves_nothing(
    plan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "new" / "out"

    def refused(*flags: str, task: str = "cable-ring") -> str:
        line = said(capsys, "distill", task, "--out", str(out), *flags)
        assert not out.parent.exists()
        return line

    assert "goal image" in refused("--agent", "goal-split")
    assert "transporter does not see" in refused("--agent", "transporter", task=TASK)
    assert "cable-rinq" in refused(task="cable-rinq")
    assert "--minutes" in refused("--minutes", "0")
    assert "cannot be read" in refused("--plan", str(tmp_path / "none.json"))
    for text in ('{"plan": 1}', '{"plan": {"demos": 1}}'):
        (tmp_path / "bad.json").write_text(text)
        assert "holds no plan" in refused("--plan", str(tmp_path / "bad.json"))
    for name, value in (("demos", 0), ("round_steps", [1]), ("round_episodes", 3), ("demos", 1.5)):
        record = {"plan": {**asdict(PLAN), name: value}}
        (tmp_path / "bad.json").write_text(json.dumps(record))
        said_so = refused("--plan", str(tmp_path / "bad.json"))
        assert "round_" in said_so or "whole" in said_so
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thing").touch()
    line = ["distill", "cable-ring", "--out", str(tmp_path / "full")]
    assert "holds something else" in said(capsys, *line)


def test_the_verb_says_what_came_of_it(
    whole: dict[str, Any], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(distilling, "distill", lambda config: whole)
    assert main(["distill", TASK, "--out", "nowhere"]) == 0
    text = capsys.readouterr().out
    assert "2 demonstrations and 2 corrected episodes" in text
    assert "CPU minutes, of a budget of 60" in text and "episodes solved" in text
