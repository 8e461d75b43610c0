"""The best policy we know to make within a budget, by one call.

A teacher that sees the simulator demonstrates; where it is the scripted one, its demonstrations are
refined by search. An agent learns from them. Then, round by round, it plays, the teacher labels
what it runs into, and it goes on learning from all labels so far. The snapshots of the last
training play validation episodes, and the best of them plays the test.

    OUT/distill.json    settings, costs and plan
    OUT/stages.jsonl    what was done, and its CPU time
    OUT/goals           what is played for, where a start's own goal shows what a test's does not
    OUT/demos, refined  demonstrations
    OUT/rounds/K        run and corrected episodes of a round
    OUT/run             the last training, with its test
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np

from warp_deform.collecting.collect import CollectConfig, collect
from warp_deform.collecting.goals import CONSTRUCTED
from warp_deform.collecting.make_goals import make_goals
from warp_deform.episodes import versions
from warp_deform.errors import InputError, WarpDeformError
from warp_deform.planning.demonstrators import demonstrator
from warp_deform.support.owned_folder import owned_folder
from warp_deform.tasks.registry import task as find_task

from ..correction.correct import CorrectConfig, correct
from ..data.dataset import remove_cache
from ..data.goal_name import GoalName
from ..data.goals import LEARNT_GOALS
from ..evaluation.run import evaluate_run
from ..policy.policy import AGENTS, AgentDescription
from ..refinement.refine import RefineConfig, refine
from ..runs.folder import read_json, write_json
from ..training.config import TrainConfig
from ..training.schedules import preset_schedule
from ..training.settings import AgentName
from ..training.train import train
from .plan import FEW, FIRST, Costs, Plan, make_plan, plan_of, read_plan
from .settings import DistillSettings
from .stages import TEST, Stages

__all__ = ["DistillConfig", "distill"]

_TIMED_STEPS = 50
"""Steps by which the cost of one is measured: a line of the log."""
_LOCK = "distill.lock"
_GOALS = 100
"""Goals that all episodes share in turn, where they have to be made."""
_FIRST_SHARE = 0.4
"""When the last training keeps its first snapshot, if it keeps several."""


@dataclass(frozen=True, kw_only=True)
class DistillConfig(DistillSettings):
    """The settings of a distillation, checked."""

    progress: bool = True
    """Show progress on stderr, see `warp_deform.support.progress`."""

    def __post_init__(self) -> None:
        AgentDescription(task=self.task, agent=self.learner, config={})  # refuses a misfit
        demonstrator(self.teacher)
        if not 0 < self.minutes < float("inf"):
            raise InputError(f"minutes is {self.minutes}; it must be a positive number")
        if self.episodes < 1 or self.seed < 0:
            raise InputError(
                f"episodes is {self.episodes} and seed {self.seed}; they must be 1 and 0 or more"
            )

    @property
    def learner(self) -> AgentName:
        """The agent that is trained."""
        if self.agent == "auto":
            return "goal-split" if find_task(self.task).goal_conditioned else "transporter"
        return self.agent

    @property
    def goal_name(self) -> GoalName:
        """What is learnt as the goal of demonstrations."""
        return "own" if find_task(self.task).goal_shows_its_start() else "end"

    @property
    def goals(self) -> Path | None:
        """Folder of the goals that demonstrator and policy go for; None: each start's own."""
        return Path(self.out).resolve() / "goals" if self.goal_name == "own" else None


def distill(config: DistillConfig) -> dict[str, Any]:
    """Distill into a folder; goes on where an earlier call with the same settings stopped.

    Returns `task`, `agent`, `teacher`, `seed`, `minutes` (the budget), `cpu_minutes` (of all but
    the test), `test_cpu_minutes`, `plan`, `stages` (`stage`, `cpu_seconds` and what it came to, in
    order), `demos`, `corrected` (episodes), `labels` (what the last training learned from), `run`
    (its folder), `selected` (step of the snapshot), `test` (see `evaluation.summary.summarise`) and
    `measure` (what the paper's table shows for the task).

    Raises:
        InputError: the settings do not fit, the budget is too small, or the folder holds another
            distillation.
        WarpDeformError: too few demonstrations succeed.
    """
    out = Path(config.out).resolve()
    planned = None if config.plan is None else read_plan(config.plan)
    with owned_folder(out, lock=_LOCK, work="distillation"):
        record = _claim(out, config)
        stages = Stages(out / "stages.jsonl", told=f"distill {config.task}" * config.progress)
        _make_goals(config, stages)
        few = FEW if planned is None else planned.demos
        if planned is None:
            _demonstrate(config, out, stages, FIRST)
        data = _demonstrate(config, out, stages, few)
        if "plan" not in record:
            costs = None if planned is not None else _measure(config, out, stages, data)
            plan = planned or make_plan(
                config.minutes, cast(Costs, costs), max_actions=find_task(config.task).max_actions
            )
            record |= {"plan": asdict(plan), "costs": None if costs is None else asdict(costs)}
            write_json(out / "distill.json", record)
        plan = plan_of(json.loads(json.dumps(record["plan"])), what=out / "distill.json")
        if plan.demos > few:
            data = _demonstrate(config, out, stages, plan.demos)
        run = _learn(config, plan, out, stages, data)
        evaluated = _test(config, plan, run, stages)
    last = stages.done["last training"]
    return {
        "task": config.task,
        "agent": config.learner,
        "teacher": config.teacher,
        "seed": config.seed,
        "minutes": config.minutes,
        "cpu_minutes": stages.minutes(),
        "test_cpu_minutes": stages.minutes(test=True),
        "plan": asdict(plan),
        "stages": [
            {"stage": name, "cpu_seconds": stages.cost[name], **stages.done[name]}
            for name in stages.done
        ],
        "demos": last["demos"] - last["corrected"],
        "corrected": last["corrected"],
        "labels": last["labels"],
        "run": str(run),
        **evaluated,
    }


def _make_goals(config: DistillConfig, stages: Stages) -> None:
    """Have goals of other starts, where a start's own would show what goals of tests do not."""
    folder = config.goals
    if folder is None:
        return

    def made() -> dict[str, Any]:
        report = make_goals(
            config.task, folder, count=_GOALS, seed=LEARNT_GOALS, kind=CONSTRUCTED, workers=1
        )
        return {"goals": report["goals"]}

    stages("goals", made, what=f"{_GOALS} goals")


def _demonstrate(config: DistillConfig, out: Path, stages: Stages, count: int) -> Path:
    """Have so many demonstrations, refined if they are to be; returns their folder."""
    demos = out / "demos"

    def collected() -> dict[str, Any]:
        report = collect(
            CollectConfig(
                task=config.task,
                episodes=count,
                out=demos,
                demonstrator=config.teacher,
                goals=config.goals,
                workers=1,
            )
        )
        if report.successes < count:
            raise WarpDeformError(
                f"only {report.successes} of {count} demonstrations by {config.teacher} solve "
                f"{config.task}; choose another --teacher"
            )
        return {
            "demonstrations": count,
            "attempts": report.attempts,
            "actions": round(count * report.mean_actions),
        }

    stages(f"{count} demonstrations", collected, what=f"{count} demonstrations by {config.teacher}")
    if config.refine == "never" or (config.refine == "auto" and config.teacher != "scripted"):
        return demos
    refined = out / f"refined-{count}"

    def better() -> dict[str, Any]:
        report = refine(RefineConfig(source=demos, out=refined, accept="solved", workers=1))
        return {
            "improved": report.improved,
            "actions_before": report.actions_before,
            "actions_after": report.actions_after,
        }

    stages(f"refining {count}", better, what=f"refining {count} demonstrations")
    return refined


def _measure(config: DistillConfig, out: Path, stages: Stages, data: Path) -> Costs:
    """What the steps of this machine cost."""

    def timed() -> dict[str, Any]:
        report = train(_training(config, data, out / "timing", steps=_TIMED_STEPS))
        return {"step": report.cpu_seconds / report.steps}

    step = stages("timing", timed, what=f"timing {_TIMED_STEPS} steps of training")["step"]
    names = [f"{count} demonstrations" for count in (FIRST, FEW)]
    before, after = (stages.done[name]["actions"] for name in names)
    spent = stages.cost[names[1]]  # on what the first ones left to do
    refined = stages.cost.get(f"refining {FEW}", 0.0) / FEW
    return Costs(
        start=stages.minutes() * 60,
        demonstration=spent / (FEW - FIRST) + refined,
        action=spent / max(after - before, 1),
        step=step,
    )


def _learn(config: DistillConfig, plan: Plan, out: Path, stages: Stages, data: Path) -> Path:
    """Train, correct, train on, and so on; returns the folder of the last run."""
    before: Path | None = None
    rounds = list(zip(plan.round_steps, plan.round_episodes, strict=True))
    for number, (steps, episodes) in enumerate(rounds, start=1):
        folder, of = out / "rounds" / str(number), f"round {number} of {len(rounds)}"
        run, corrected = folder / "run", folder / "corrected"
        training = _training(config, data, run, steps=steps, start=before)
        stages(f"training {number}", partial(_trained, training), what=f"{of}, {steps} steps")
        by = CorrectConfig(
            run=run,
            data=data,
            out=corrected,
            teacher=config.teacher,
            episodes=episodes,
            goals=config.goals,
            workers=1,
        )
        what = f"{of}, {episodes} episodes to correct"
        said = stages(f"correction {number}", partial(_corrected, by), what=what)
        if not said["corrected"]:
            raise WarpDeformError(
                f"{config.teacher} labels none of {episodes} episodes; choose another --teacher"
            )
        remove_cache(data)  # a third of a megabyte a state, and the next folder holds them again
        before, data = run, corrected
    last, what = out / "run", f"last training, {plan.last_steps} steps"
    training = _training(
        config,
        data,
        last,
        steps=plan.last_steps,
        snapshots=plan.snapshots,
        validate=plan.validation,
        start=before,
    )
    stages("last training", partial(_trained, training), what=what)
    remove_cache(data)
    return last


def _training(
    config: DistillConfig,
    data: Path,
    out: Path,
    *,
    steps: int,
    snapshots: int = 1,
    validate: int = 0,
    start: Path | None = None,
) -> TrainConfig:
    """A training by the preset `fast` that takes all steps, unless all of validation is solved."""
    usual = preset_schedule("fast", task=config.task, demos=0, sees=AGENTS[config.learner].sees)
    shares = np.linspace(_FIRST_SHARE, 1.0, snapshots) if snapshots > 1 else (1.0,)
    schedule = replace(
        usual,
        steps=steps,
        warmup=min(usual.warmup, steps // 4),
        shares=tuple(map(float, shares)),
        validate=validate,
        confirm=validate,
    )
    return TrainConfig(
        task=config.task,
        agent=config.learner,
        data=data,
        out=out,
        goal=config.goal_name,
        preset="fast",
        schedule=schedule,
        patience=0,
        seed=config.seed,
        start=start,
        progress=config.progress,
    )


def _trained(config: TrainConfig) -> dict[str, Any]:
    report = train(config)
    said = {key: getattr(report, key) for key in ("steps", "demos", "corrected", "labels")}
    validation = {str(step): each for step, each in report.validation.items()}
    return {**said, "validation": validation, "weights_hash": report.weights_hash}


def _corrected(config: CorrectConfig) -> dict[str, Any]:
    report = asdict(correct(config))
    return {key: report[key] for key in ("episodes", "corrected", "solved", "labels", "mean_score")}


def _test(config: DistillConfig, plan: Plan, run: Path, stages: Stages) -> dict[str, Any]:
    """Choose a snapshot by what validation played, and test it."""

    def tested() -> dict[str, Any]:
        report = evaluate_run(
            run,
            episodes=config.episodes,
            validation_episodes=plan.validation,
            workers=1,
            progress=config.progress,
        )
        return {key: report[key] for key in ("selected", "test", "measure")}

    evaluated: dict[str, Any] = stages(TEST, tested, what=f"{config.episodes} test episodes")
    return evaluated


def _claim(out: Path, config: DistillConfig) -> dict[str, Any]:
    """Write what is distilled into the folder, or compare it with what the folder says.

    Raises:
        InputError: the folder holds something else.
    """
    path = out / "distill.json"
    settings = {**asdict(config), "agent": config.learner}
    if config.goal_name != "end":
        settings["goal"] = config.goal_name
    for name in ("out", "progress", "plan"):
        del settings[name]
    wanted: dict[str, Any] = {"settings": settings, "versions": versions()}
    if config.plan is not None:
        wanted["planned"] = asdict(read_plan(config.plan))
    wanted = json.loads(json.dumps(wanted))
    if not path.exists():
        if any(each.name != _LOCK for each in out.iterdir()):
            raise InputError(f"{out} holds something else; choose another --out")
        write_json(path, wanted)
        return wanted
    stored = read_json(path)
    for key in ("settings", "versions", "planned"):
        if stored.get(key) != wanted.get(key):
            what = _first_difference(stored.get(key), wanted.get(key)) or key
            raise InputError(
                f"{out} holds a distillation with another {what}; choose another --out"
            )
    return stored


def _first_difference(a: Any, b: Any) -> str | None:
    if not (isinstance(a, dict) and isinstance(b, dict)):
        return None
    return next((key for key in sorted({*a, *b}) if a.get(key) != b.get(key)), None)
