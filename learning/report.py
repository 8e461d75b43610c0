"""The paper's tables from run folders: runs pooled over seeds, the paper's numbers beside ours.

A cell is a task, an agent, a number of demonstrations and a variant: preset, steps where they are
not the preset's, who chooses the lift, whose goals, which arm, who demonstrated. Runs of a cell
differ in their seed alone. Their test episodes are counted together for the share of successes and
its Wilson interval; standard errors are those between runs where there are several, else those
between episodes. Training runs share their test seeds, so the interval speaks of the runs that were
made and not of training again.

Source: Wilson, JASA 1927; numbers of Seita et al., ICRA 2021, in `paper_results.json`.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warp_deform.errors import InputError
from warp_deform.tasks.registry import TASKS

from .evaluation import wilson
from .paper_results import PARTIAL_SCORE, SUCCESS, PaperResults, partial_credit, read_paper
from .schedules import SCHEDULES, preset_schedule
from .snapshots import RunFolder

__all__ = ["Cell", "Point", "Report", "RunResult", "pool", "read_runs", "version_notes",
           "write_report"]  # fmt: skip

_ALIKE = ("agent", "schedule", "augment", "processes", "device", "patience")
"""Settings that runs of a cell have in common."""
_SPREAD = ("snapshots", "doubling", "validate")
"""Of a schedule: when snapshots are taken, and what they play, which is compared by itself."""
_VERSIONS = ("warp-deform", "torch")


@dataclass(frozen=True)
class Point:
    """A value [%] and its standard error [%], after so many steps of training."""

    step: int
    value: float
    error: float | None


@dataclass(frozen=True)
class RunResult:
    """An evaluated run. info: `eval_info.json`; settings: `run.json`."""

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

    n_episodes, n_success, pc_success [%], pc_success_ci95 [%]: of the test episodes of all runs
    n_success_enclosed: successes whose items the bag enclosed; None without items, or where a run
    does not say
    mean_score: in [0, 1], with its standard_error; mean_actions: of all test episodes
    value, value_error [%]: what the paper's table shows for the task (`measure`), on our test seeds
    paper_protocol [%]: the same by the paper's protocol, which is optimistic; None if not played
    paper_protocol_stage_rule: who chose the lift there, "action" or "privileged"
    paper [%]: the paper's number; None where it has none
    failures: how often each of `failures.FAILURES` happened
    validation, test: learning curves; `test` where the paper's protocol was played
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
    validation: tuple[Point, ...]
    test: tuple[Point, ...]


@dataclass(frozen=True)
class Report:
    """What a report says: as a JSON object, and as Markdown."""

    data: dict[str, Any]
    text: str


def write_report(paths: Sequence[Path], out: Path | None) -> Report:
    """Tables of the evaluated runs in folders; with `out`, files of them and of the curves too.

    The object has `runs`, `cells` (the fields of `Cell`), `origins` (of each run, see
    `report_origins.origin`), `notes` and `files` (paths).

    Raises:
        InputError: no evaluated run, runs that cannot be told apart, or a folder that cannot be
            made.
    """
    from .report_curves import draw_curves
    from .report_origins import origin
    from .report_tables import csv_text, latex_text, markdown_text

    runs, notes = read_runs(paths)
    paper = read_paper()
    cells = pool(runs, paper)
    notes += version_notes(runs)
    files: list[Path] = []
    made = [origin(run) for run in runs]
    text = markdown_text(cells, paper, notes, made=made)
    if out is not None:
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"--out {out} cannot be made: {error.strerror}") from error
        pictures = draw_curves(cells, paper, out)
        texts = {
            "report.md": markdown_text(cells, paper, notes, pictures, made=made),
            "report.csv": csv_text(cells),
            "report.tex": latex_text(cells, paper),
        }
        for name, content in texts.items():
            (out / name).write_text(content)
        files = [*(out / name for name in texts), *pictures]
    data = {
        "runs": len(runs),
        "origins": made,
        "cells": [asdict(cell) for cell in cells],
        "notes": notes,
        "files": [str(path) for path in files],
    }
    return Report(data, text)


def read_runs(paths: Sequence[Path]) -> tuple[list[RunResult], list[str]]:
    """Evaluated runs of folders, each a run or holding runs at any depth; and notes on the others.

    Raises:
        InputError: a folder is missing or holds no run, none is evaluated, or a file is damaged.
    """
    folders: dict[Path, Path] = {}
    for path in paths:
        here = [path] if (path / "run.json").is_file() else sorted(_inside(path))
        if not here:
            raise InputError(
                f"{path} holds no training run; `warp-deform train` makes one with --out"
            )
        folders |= {each.resolve(): each for each in here}
    runs, notes = [], []
    for folder in folders.values():
        run = RunFolder(folder)
        if run.report.is_file():
            info = run.read_report()
            notes += _other_seeds(folder, info)
            if info["test"] is not None:
                runs.append(_read(run))
                continue
        if not run.report.is_file() or info["test"] is None:
            notes.append(f"{folder} is not evaluated and left out; run `warp-deform eval {folder}`")
    if not runs:
        raise InputError(f"no run is evaluated yet; run `warp-deform eval {next(iter(folders))}`")
    return runs, notes


def _other_seeds(folder: Path, info: Mapping[str, Any]) -> list[str]:
    """A line for every set of other seeds that a run played."""
    return [
        f"{folder} also played seeds {other['first_seed']} and up: {other['test']['n_success']} of "
        f"{other['test']['n_episodes']} solved, mean score {other['test']['mean_score']:.3f}; "
        "tables and curves leave them out"
        for other in info.get("other_seeds", {}).values()
    ]


def _inside(path: Path) -> Iterable[Path]:
    if not path.is_dir():
        raise InputError(f"there is no folder {path}")
    return (found.parent for found in path.rglob("run.json"))


def _read(run: RunFolder) -> RunResult:
    info, settings = run.read_report(), run.read_settings()
    try:
        result = RunResult(
            path=run.path,
            task=info["task"],
            agent=info["agent"],
            demos=info["demos"],
            seed=info["seed"],
            variant=_variant(info, settings),
            info=info,
            settings=settings,
        )
        _cell([result], None)  # all that is needed later is there
        _compared(result)
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise InputError(
            f"{run.report} is not what this release's `warp-deform eval` writes; evaluate again"
        ) from error
    return result


def _variant(info: Mapping[str, Any], settings: Mapping[str, Any]) -> str:
    """How a run was trained and played, but for task, agent, demonstrations and seed."""
    parts = [info["preset"], *_steps(info, settings)]
    if info["stage_rule"] != "action":
        parts.append(f"{info['stage_rule']} lift")
    if not info["retry"]:
        parts.append("no retries")
    if info["goals"] != "constructed":
        parts.append(f"goals {info['goals']}")
    if info["robot"] != "ur5":
        parts.append(info["robot"])
    names = settings["demonstrators"]
    if names != ["scripted"]:
        parts.append(f"{' and '.join(names)} demonstrations")
    return ", ".join(parts)


def _steps(info: Mapping[str, Any], settings: Mapping[str, Any]) -> list[str]:
    """How long a run was trained, where that is not its preset's length.

    Where validation may stop it, as long as that allowed.
    """
    planned, trained = int(settings["schedule"]["steps"]), int(info["trained_steps"])
    if settings.get("patience") is not None:
        return [f"up to {planned} steps, patience {settings['patience']}"]
    if settings.get("validate"):
        return [f"up to {planned} steps"]
    if trained != planned:
        return [f"{trained} of {planned} steps"]
    usual = None
    if info["preset"] in SCHEDULES:
        usual = preset_schedule(
            info["preset"], task=info["task"], demos=info["demos"],
            sees_state=settings["agent"].get("state_size") is not None,
        )  # fmt: skip
    return [] if usual is not None and planned == usual.steps else [f"{planned} steps"]


def pool(runs: Sequence[RunResult], paper: PaperResults) -> list[Cell]:
    """Cells of runs, ordered by variant, task, agent and number of demonstrations.

    Raises:
        InputError: two runs of a cell have the same seed, or differ in more than the seed.
    """
    groups = _grouped(runs)
    for members in groups.values():
        _check_alike(members)
    order = {name: n for n, name in enumerate(TASKS)}
    keys = sorted(groups, key=lambda k: (k[0], order.get(k[1], len(order)), *k[1:]))
    return [_cell(sorted(groups[key], key=lambda run: run.seed), paper) for key in keys]


def version_notes(runs: Sequence[RunResult]) -> list[str]:
    """A line for every cell whose runs were trained by different versions of what decides."""
    notes = []
    for members in _grouped(runs).values():
        for name in _VERSIONS:
            found = {str(run.settings.get("versions", {}).get(name)) for run in members}
            if len(found) > 1:
                first = members[0]
                notes.append(
                    f"{first.task}, {first.agent}, {first.demos} demonstrations ({first.variant}): "
                    f"trained by different versions of {name}, {', '.join(sorted(found))}, and "
                    "taken together all the same"
                )
    return notes


def _grouped(
    runs: Sequence[RunResult],
) -> dict[tuple[str, str, str, int], list[RunResult]]:
    """Runs by cell: variant, task, agent, number of demonstrations."""
    groups: dict[tuple[str, str, str, int], list[RunResult]] = defaultdict(list)
    for run in runs:
        groups[run.variant, run.task, run.agent, run.demos].append(run)
    return groups


def _check_alike(members: Sequence[RunResult]) -> None:
    first = members[0]
    seen: dict[int, Path] = {}
    for run in members:
        if run.seed in seen:
            raise InputError(
                f"{seen[run.seed]} and {run.path} are both seed {run.seed} of {run.task} with "
                f"{run.agent} and {run.demos} demonstrations; name one of them"
            )
        seen[run.seed] = run.path
        mine, theirs = _compared(run), _compared(first)
        for key, value in mine.items():
            if value is not None and theirs.get(key) is not None and value != theirs[key]:
                raise InputError(
                    f"{first.path} and {run.path} differ in {key}, so their results are not one; "
                    "report them apart"
                )


def _compared(run: RunResult) -> dict[str, Any]:
    """What runs of a cell have in common; None where it is not known."""
    settings, info, paper = run.settings, run.info, run.info["paper"]
    compared = {key: settings.get(key) for key in _ALIKE}
    schedule = settings["schedule"]
    compared["schedule"] = {key: each for key, each in schedule.items() if key not in _SPREAD}
    compared["test episodes"] = info["test"]["n_episodes"]
    compared["validation episodes"] = info["snapshots"][str(info["selected"])]["n_episodes"]
    if settings.get("validate"):
        compared["validation episodes in training"] = settings.get("validate")
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
    """Mean over all episodes of several runs, and its standard error (see the module)."""
    values = [value for value, _, _ in results]
    mean = float(np.average(values, weights=[n for _, _, n in results]))
    if len(results) == 1:
        return mean, results[0][1]
    return mean, float(np.std(values, ddof=1) / math.sqrt(len(values)))


def _curve(snapshots: Sequence[Mapping[str, Mapping[str, Any]]], task: str) -> tuple[Point, ...]:
    """Results by step, over the runs that have the step."""
    steps = sorted({int(step) for each in snapshots for step in each})
    found = []
    for step in steps:
        there = [_value(each[str(step)], task) for each in snapshots if str(step) in each]
        found.append(Point(step, *_together(there)))
    return tuple(found)
