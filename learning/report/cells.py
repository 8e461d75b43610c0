"""Runs that were trained alike but for their seed, together, with the paper's number beside ours.

A cell is a task, an agent, a number of demonstrations and a variant: preset, steps where they are
not the preset's, who chooses the lift, whose goals, which arm, who demonstrated. Runs of a cell
differ in their seed, and in what computed them at most. Their test episodes are counted together
for the share of successes and its Wilson interval. The standard error is the greater one of that
between runs and that between episodes. Training runs share their test seeds, so the interval speaks
of the runs that were made and not of training again.

Source: Wilson, JASA 1927; numbers of Seita et al., ICRA 2021, in `paper_results.json`.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warp_deform.errors import InputError
from warp_deform.tasks.registration import env_id
from warp_deform.tasks.registry import TASKS, is_known

from ..evaluation.paper_results import PARTIAL_SCORE, SUCCESS, PaperResults, partial_credit
from ..evaluation.summary import wilson
from ..runs.folder import network_settings

__all__ = ["Cell", "CurvePoint", "RunResult", "check_run", "environment_notes", "pool",
           "version_notes"]  # fmt: skip

_ALIKE = ("schedule", "augment", "in_view", "processes", "patience")
"""Settings that runs of a cell have in common."""
_PRECISION = "bfloat16"
_SPREAD = ("snapshots", "doubling", "shares", "validate", "confirm", "patience")
"""Of a schedule: when snapshots are taken, and what they play, which is compared by itself."""


@dataclass(frozen=True)
class CurvePoint:
    """A value [%] and its standard error [%], after so many steps of training."""

    step: int
    value: float
    error: float | None


@dataclass(frozen=True)
class RunResult:
    """An evaluated run.

    Attributes:
        info: what `eval_info.json` says
        settings: what `run.json` says
    """

    path: Path
    task: str
    agent: str
    demos: int
    seed: int
    variant: str
    info: Mapping[str, Any]
    settings: Mapping[str, Any]


@dataclass(frozen=True, kw_only=True)
class Cell:
    """Runs that differ in their seed alone, taken together.

    Attributes:
        n_episodes: test episodes of all runs
        n_success: those that were solved
        pc_success: their share [%]
        pc_success_ci95: 95 % interval of the share, low and high [%]
        n_success_enclosed: successes whose items the bag enclosed; None without items, or where a
            run does not say
        mean_score: from 0 to 1
        standard_error: of the mean score
        mean_actions: of all test episodes
        value: what the paper's table shows for the task (`measure`), on our test seeds [%]
        value_error: its standard error [%]
        paper_protocol: the same by the paper's protocol, which is optimistic [%]; None if not
            played
        paper_protocol_stage_rule: who chose the lift there, "action" or "privileged"
        paper: the paper's number [%]; None where it has none
        failures: how often each of `summary.FAILURES` happened
        validation: learning curve on validation episodes
        test: learning curve on test episodes, where the paper's protocol was played
    """

    task: str
    agent: str
    demos: int
    variant: str
    seeds: tuple[int, ...]
    n_episodes: int
    n_success: int
    n_success_enclosed: int | None
    pc_success: float
    pc_success_ci95: tuple[float, float]
    mean_score: float
    standard_error: float | None
    mean_actions: float
    measure: str
    value: float
    value_error: float | None
    paper_protocol: float | None
    paper_protocol_runs: int
    paper_protocol_stage_rule: str | None
    paper: float | None
    failures: dict[str, int]
    validation: tuple[CurvePoint, ...]
    test: tuple[CurvePoint, ...]


def pool(runs: Sequence[RunResult], paper: PaperResults) -> list[Cell]:
    """Cells of runs, ordered by variant, task, agent and number of demonstrations.

    Raises:
        InputError: two runs of a cell have the same seed, or were trained or tested differently.
    """
    groups = _grouped(runs)
    for members in groups.values():
        _check_alike(members)
    order = {name: n for n, name in enumerate(TASKS)}
    keys = sorted(groups, key=lambda k: (k[0], order.get(k[1], len(order)), *k[1:]))
    return [_cell(sorted(groups[key], key=lambda run: run.seed), paper) for key in keys]


def check_run(run: RunResult) -> None:
    """See that a run has all that a cell is made of; LookupError, TypeError, ... if not."""
    _cell([run], None)
    _compared(run)


def version_notes(runs: Sequence[RunResult]) -> list[str]:
    """A line for every cell whose runs were computed differently: versions, devices, precisions."""
    notes = []
    for members in _grouped(runs).values():
        computed = [_computed_by(run) for run in members]
        for name in computed[0]:
            values = {each[name] for each in computed}
            if len(values) > 1:
                first = members[0]
                notes.append(
                    f"{first.task}, {first.agent}, {first.demos} demonstrations ({first.variant}): "
                    f"trained with different {name}, {', '.join(sorted(values))}, and taken "
                    "together all the same"
                )
    return notes


def _computed_by(run: RunResult) -> dict[str, str]:
    """By what a run was computed, which seeds of a cell may differ in."""
    settings = run.settings
    versions, network = settings.get("versions", {}), settings["agent"]["config"]
    return {
        "versions of warp-deform": str(versions.get("warp-deform")),
        "versions of torch": str(versions.get("torch")),
        "devices": str(settings.get("device")),
        "precisions": "bfloat16" if network.get(_PRECISION) else "float32",
    }


def environment_notes(runs: Sequence[RunResult]) -> list[str]:
    """A line for every run that was tested on another version of its task than the present one."""
    return [
        f"{run.task}, {run.agent}, {run.demos} demonstrations, seed {run.seed}: tested on "
        f"{tested}, which is {env_id(run.task)} now"
        for run in runs
        if (tested := run.info.get("environment")) is not None
        and is_known(run.task)
        and tested != env_id(run.task)
    ]


def _grouped(
    runs: Sequence[RunResult],
) -> dict[tuple[str, str, str, int], list[RunResult]]:
    """Runs by cell: variant, task, agent, number of demonstrations."""
    groups: dict[tuple[str, str, str, int], list[RunResult]] = defaultdict(list)
    for run in runs:
        groups[run.variant, run.task, run.agent, run.demos].append(run)
    return groups


def _check_alike(members: Sequence[RunResult]) -> None:
    seen: dict[int, Path] = {}
    known: dict[str, tuple[Path, Any]] = {}
    for run in members:
        if run.seed in seen:
            raise InputError(
                f"{seen[run.seed]} and {run.path} are both seed {run.seed} of {run.task} with "
                f"{run.agent} and {run.demos} demonstrations; name one of them"
            )
        seen[run.seed] = run.path
        for key, value in _compared(run).items():
            if value is None:
                continue
            path, other = known.setdefault(key, (run.path, value))
            if value != other:
                raise InputError(
                    f"{path} and {run.path} differ in {key}, so their results are not one; "
                    "report them apart"
                )


def _compared(run: RunResult) -> dict[str, Any]:
    """What runs of a cell have in common; None where it is not known."""
    settings, info, paper = run.settings, run.info, run.info["paper"]
    compared = {key: settings.get(key) for key in _ALIKE}
    agent = settings["agent"]
    compared["agent"] = {**agent, "config": network_settings(agent)}
    schedule = {"place_lr": 1.0, "even": 0.0} | settings["schedule"]
    compared["schedule"] = {
        key: each
        for key, each in schedule.items()
        # without a place network its step size says nothing
        if key not in _SPREAD and (key != "place_lr" or run.agent == "gt-mlp-2step")
    }
    compared["environment"] = info.get("environment")
    compared["test episodes"] = info["test"]["n_episodes"]
    compared["validation episodes"] = info["snapshots"][str(info["selected"])]["n_episodes"]
    if settings.get("validate"):
        compared["validation episodes in training"] = settings.get("validate")
        played = [each for step, each in info["snapshots"].items() if int(step)]
        solved_all = any(each["n_success"] == each["n_episodes"] for each in played)
        if solved_all or int(info["trained_steps"]) < int(schedule["steps"]):
            # else the rule never came into play
            compared["further ones that confirm"] = schedule.get("confirm", 0)
    if paper is not None:
        compared["who chooses the lift by the paper's protocol"] = paper["stage_rule"]
    return compared


def _cell(runs: Sequence[RunResult], paper: PaperResults | None) -> Cell:
    first, tests = runs[0], [run.info["test"] for run in runs]
    task = first.task
    n, solved = (sum(int(t[key]) for t in tests) for key in ("n_episodes", "n_success"))
    failures = Counter[str]()
    for t in tests:
        failures.update(t["failures"])
    weights = [t["n_episodes"] for t in tests]
    score, score_error = _together(
        [(t["mean_score"], t["standard_error"], t["n_episodes"]) for t in tests]
    )
    value, value_error = _together([_value(t, task) for t in tests])
    played = [run.info["paper"] for run in runs if run.info["paper"] is not None]
    theirs = [p["snapshots"] for p in played]
    curve = _curve(theirs, task)
    whole = [p.value for p in curve if p.step and all(str(p.step) in each for each in theirs)]
    return Cell(
        task=task,
        agent=first.agent,
        demos=first.demos,
        variant=first.variant,
        seeds=tuple(run.seed for run in runs),
        n_episodes=n,
        n_success=solved,
        n_success_enclosed=_all_of([t.get("n_success_enclosed") for t in tests]),
        pc_success=100 * solved / n,
        pc_success_ci95=wilson(solved, n),
        mean_score=score,
        standard_error=score_error,
        mean_actions=float(np.average([t["mean_actions"] for t in tests], weights=weights)),
        measure=PARTIAL_SCORE if partial_credit(task) else SUCCESS,
        value=value,
        value_error=value_error,
        paper_protocol=max(whole, default=None),
        paper_protocol_runs=len(played),
        paper_protocol_stage_rule=played[0]["stage_rule"] if played else None,
        paper=paper.values.get((task, first.agent, first.demos)) if paper else None,
        failures=dict(sorted(failures.items())),
        validation=_curve([run.info["snapshots"] for run in runs], task),
        test=curve,
    )


def _all_of(counts: Sequence[int | None]) -> int | None:
    """Sum of counts; None where one of them is not known."""
    known = [count for count in counts if count is not None]
    return sum(known) if len(known) == len(counts) else None


def _value(summary: Mapping[str, Any], task: str) -> tuple[float, float | None, int]:
    """What the paper's table shows of a result [%], its standard error and number of episodes."""
    n = int(summary["n_episodes"])
    if partial_credit(task):
        error = summary["standard_error"]
        return 100 * float(summary["mean_score"]), None if error is None else 100 * error, n
    rate = int(summary["n_success"]) / n
    return 100 * rate, 100 * math.sqrt(rate * (1 - rate) / (n - 1)) if n > 1 else None, n


def _together(
    results: Sequence[tuple[float, float | None, int]],
) -> tuple[float, float | None]:
    """Mean over all episodes of several runs, and its standard error (see the module).

    Two or three runs that happen to agree say little of the spread between runs.
    """
    values = [value for value, _, _ in results]
    mean = float(np.average(values, weights=[n for _, _, n in results]))
    if len(results) == 1:
        return mean, results[0][1]
    between = float(np.std(values, ddof=1) / math.sqrt(len(values)))
    errors = [error for _, error, _ in results if error is not None]
    within = math.sqrt(sum(error**2 for error in errors)) / len(values)
    return mean, max(between, within)


def _curve(
    snapshots: Sequence[Mapping[str, Mapping[str, Any]]], task: str
) -> tuple[CurvePoint, ...]:
    """Results by step, over the runs that have the step."""
    steps = sorted({int(step) for each in snapshots for step in each})
    points = []
    for step in steps:
        values = [_value(each[str(step)], task) for each in snapshots if str(step) in each]
        points.append(CurvePoint(step, *_together(values)))
    return tuple(points)
