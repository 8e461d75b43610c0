"""A grid of tasks, agents, numbers of demonstrations and seeds, trained and evaluated.

Every cell of the grid is a training run in a folder of its own, so nothing but the folders is
needed to go on after an interruption: demonstrations, training and evaluation each resume by
themselves, and a run that is done says so in `sweep.json`. Runs are spread over processes of one
thread each, by joblib on one machine or Ray on a cluster whose machines share the folder; what a
lost machine had in hand is done again on another one.

    OUT/demos/TASK                    demonstrations
    OUT/runs/TASK-AGENT-DEMOS-sSEED   training runs
    OUT/report                        tables and curves of those that are done
"""

from __future__ import annotations

import difflib
import json
import os
import sys
import time
import tomllib
from collections.abc import Iterator
from dataclasses import MISSING, asdict, dataclass, field, fields, replace
from itertools import product
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, get_args, get_origin, get_type_hints

import joblib

from warp_deform.collecting.collect import CollectConfig, collect
from warp_deform.collecting.settings import DemonstratorName
from warp_deform.collecting.workers import Workers, worker_count
from warp_deform.episodes import EpisodeReader
from warp_deform.errors import InputError, WarpDeformError
from warp_deform.planning.demonstrators import demonstrator
from warp_deform.robots import robot as find_robot
from warp_deform.support.owned_folder import owned_folder
from warp_deform.support.progress import progress_bar
from warp_deform.tasks.registry import task as find_task

from .data.goals import check_goals_are_given
from .evaluation.run import evaluate_run
from .evaluation.settings import EvalSettings
from .models.transporter import Transporter
from .policy.policy import AGENTS, AgentDescription
from .report.report import write_report
from .runs.folder import read_json, write_json
from .training.config import TrainConfig
from .training.settings import AgentName, PresetName, TrainMethod
from .training.train import train

__all__ = ["Collecting", "Evaluating", "SweepConfig", "read_sweep", "run_sweep"]

_DONE = "sweep.json"


@dataclass(frozen=True, kw_only=True)
class Collecting:
    """Where demonstrations come from. The section `demonstrations` of the file.

    Attributes:
        folder: holds a folder of demonstrations a task; None: OUT/demos
        count: to collect where a task has fewer; None: as many as the largest run needs
        seed: first one of the collection
        demonstrator: who acts
    """

    folder: Path | None = None
    count: int | None = None
    seed: int = 0
    demonstrator: DemonstratorName = "scripted"


@dataclass(frozen=True, kw_only=True)
class Evaluating(EvalSettings):
    """How runs are evaluated, see `evaluation.run.evaluate_run`. The section `evaluation`."""

    retry: bool = True
    """Agents over pictures remember what they missed; the paper's do not."""


@dataclass(frozen=True, kw_only=True)
class SweepConfig(TrainMethod):
    """A grid. The fields are the keys of the file; those without a default have to be there.

    precision: of agents over pictures
    Agents are combined with the tasks that they fit: those that see a goal, with tasks that have
    one.
    """

    out: Path
    tasks: tuple[str, ...]
    agents: tuple[AgentName, ...]
    demos: tuple[int, ...]
    seeds: tuple[int, ...] = (0,)
    preset: PresetName = "fast"
    demonstrations: Collecting = field(default_factory=Collecting)
    evaluation: Evaluating = field(default_factory=Evaluating)

    def __post_init__(self) -> None:
        for name in ("tasks", "agents", "demos", "seeds"):
            values = getattr(self, name)
            if not values or len(set(values)) < len(values):
                raise InputError(
                    f"{name} is {list(values)}; it must name at least one, and none twice"
                )
        for task in self.tasks:
            find_task(task)
        for agent in self.agents:
            if agent not in AGENTS:
                raise InputError(f"there is no agent {agent!r}; there are: {', '.join(AGENTS)}")
        for name, least in (("demos", 1), ("seeds", 0)):
            _at_least(name, min(getattr(self, name)), least)
        rule = self.evaluation.stage_rule
        if rule not in ("action", "privileged"):
            raise InputError(f"stage_rule is {rule!r}; it must be 'action' or 'privileged'")
        for name in ("episodes", "validation_episodes"):
            _at_least(f"evaluation.{name}", getattr(self.evaluation, name), 1)
        if self.demonstrations.count is not None:
            _at_least("demonstrations.count", self.demonstrations.count, 1)
        _at_least("demonstrations.seed", self.demonstrations.seed, 0)
        find_robot(self.evaluation.robot)
        demonstrator(self.demonstrations.demonstrator)
        for task in self.tasks:
            if not any(_fits(task, agent) for agent in self.agents):
                raise InputError(f"none of the agents {', '.join(self.agents)} fits {task}")
        for cell in self.cells():
            if cell.goal == "own":
                check_goals_are_given(
                    find_task(cell.task),
                    given=self.demonstrations.folder is not None and self.data(cell.task).is_dir(),
                    advice="collect demonstrations for given goals (`demo --goals`) and name what "
                    "holds their folder by demonstrations.folder",
                )

    def cells(self) -> list[TrainConfig]:
        """The training runs, those with few demonstrations first."""
        grid = product(self.demos, self.tasks, self.agents, self.seeds)
        return [self._cell(*each) for each in grid if _fits(each[1], each[2])]

    def data(self, task: str) -> Path:
        """Folder of a task's demonstrations."""
        return (self.demonstrations.folder or self.out / "demos") / task

    def _cell(self, demos: int, task: str, agent: AgentName, seed: int) -> TrainConfig:
        method = {each.name: getattr(self, each.name) for each in fields(TrainMethod)}
        if not issubclass(AGENTS[agent], Transporter):
            method["precision"] = "auto"
        if AGENTS[agent].sees == "traces":
            method["goal"] = "end"  # it learns of no goal
        return TrainConfig(
            task=task,
            agent=agent,
            data=self.data(task),
            out=self.out / "runs" / f"{task}-{agent}-{demos}-s{seed}",
            demos=demos,
            seed=seed,
            progress=False,
            **method,
        )


def read_sweep(path: Path) -> SweepConfig:
    """The grid that a TOML file describes; paths in it are relative to the working directory.

    Raises:
        InputError: there is no such file, or something in it is wrong.
    """
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from error
    except ValueError as error:  # not TOML, or not UTF-8
        raise InputError(f"{path} is no TOML file: {error}") from error
    try:
        sections = {
            name: _section(kind, data.pop(name, {}), f"{name}.")
            for name, kind in (("demonstrations", Collecting), ("evaluation", Evaluating))
        }
        config: SweepConfig = _section(SweepConfig, data, "", **sections)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return config


def run_sweep(
    config: SweepConfig, *, workers: int | None = None, ray: str | None = None
) -> dict[str, Any]:
    """Do what is left of a grid, then report all of it that is done.

    Returns `out`, `runs` (of the grid), `skipped` (done before), `failed` (each `run`, `error`),
    `seconds` [s] and `report` (path of the tables, None if nothing is done).

    Raises:
        InputError: bad options, or another sweep is at work in the folder.
        WarpDeformError: a worker process was killed; what had been finished is kept.
    """
    began = time.perf_counter()
    config = _resolved(config)
    cells = config.cells()
    todo = [cell for cell in cells if not _done(cell, config)]
    count = workers
    if ray is None:
        most = joblib.cpu_count() if workers is None else worker_count(workers, len(todo))
        count = min(most, max(len(todo), 1))
    crew = Workers(count, ray=ray)
    failed: list[dict[str, str]] = []
    with owned_folder(config.out, lock="sweep.lock", work="sweep"):
        for task in dict.fromkeys(cell.task for cell in todo):
            _collect(config, task, workers=workers, ray=ray)
        bar = progress_bar("sweep", len(cells), done=len(cells) - len(todo), unit="runs")
        with crew, bar as advance:
            for name, said, error in crew.run(_run, [(cell, config) for cell in todo]):
                print(f"{name}: {error or said}", file=sys.stderr, flush=True)
                advance()
                if error:
                    failed.append({"run": name, "error": error})
        done = [cell.out for cell in cells if _done(cell, config)]
        report = config.out / "report"
        if done:
            write_report(done, report)
    return {
        "out": str(config.out),
        "runs": len(cells),
        "skipped": len(cells) - len(todo),
        "failed": sorted(failed, key=lambda each: each["run"]),
        "seconds": time.perf_counter() - began,
        "report": str(report / "report.md") if done else None,
    }


def _at_least(name: str, value: int, least: int) -> None:
    if value < least:
        raise InputError(f"{name} is {value}; it must be {least} or more")


def _fits(task: str, agent: str) -> bool:
    """Whether an agent can be trained on a task."""
    try:
        AgentDescription(task=task, agent=agent, config={})
    except InputError:
        return False
    return True


def _wanted(cell: TrainConfig, config: SweepConfig) -> dict[str, Any]:
    """What a run was to be, for the file that says that it is done."""
    data = os.path.relpath(cell.data, config.out)  # the whole may be moved
    settings = {**asdict(cell), "data": data, "out": None, "progress": None}
    wanted: dict[str, Any] = json.loads(
        json.dumps({"training": settings, "evaluation": asdict(config.evaluation)})
    )
    return wanted


def _resolved(config: SweepConfig) -> SweepConfig:
    """With absolute paths: a worker elsewhere need not stand where this process does."""
    where = config.demonstrations
    folder = None if where.folder is None else where.folder.resolve()
    return replace(config, out=config.out.resolve(), demonstrations=replace(where, folder=folder))


def _done(cell: TrainConfig, config: SweepConfig) -> bool:
    """Whether a run is trained and evaluated as the grid wants it."""
    record = cell.out / _DONE
    return record.is_file() and read_json(record) == _wanted(cell, config)


def _collect(config: SweepConfig, task: str, *, workers: int | None, ray: str | None) -> None:
    """Collect a task's demonstrations, unless there are enough.

    How many files a folder holds says nothing of one that was being collected into: until the
    end there may be more than are wanted, and others than are kept. `collect` knows; a folder that
    the user names may come from anywhere and is taken as it is.
    """
    folder, wanted = config.data(task), config.demonstrations
    count = wanted.count or max(config.demos)
    collected = 0
    if wanted.folder is not None and any(folder.glob("*.parquet")):
        collected = len(EpisodeReader(folder))
    if collected < count:
        collect(
            CollectConfig(
                task=task,
                episodes=count,
                out=folder,
                seed=wanted.seed,
                demonstrator=wanted.demonstrator,
                robot=config.evaluation.robot,
                workers=workers,
                ray=ray,
            )
        )


def _run(job: tuple[TrainConfig, SweepConfig]) -> Iterator[tuple[str, str, str | None]]:
    """Train and evaluate one run: its name, its result, and what went wrong if anything did."""
    cell, config = job
    began = time.perf_counter()
    try:
        train(cell)
        test = evaluate_run(cell.out, workers=1, progress=False, **asdict(config.evaluation))[
            "test"
        ]
    except Exception as error:  # whatever it is, the other runs go on
        kind = "" if isinstance(error, WarpDeformError) else f"{type(error).__name__}: "
        yield cell.out.name, "", kind + " ".join(str(error).split())
        return
    write_json(cell.out / _DONE, _wanted(cell, config))
    minutes = (time.perf_counter() - began) / 60
    said = f"{test['n_success']} of {test['n_episodes']} solved, score {test['mean_score']:.3f}"
    yield cell.out.name, f"{said}, {minutes:.1f} min", None


def _section(kind: type[Any], data: object, where: str, **given: Any) -> Any:
    """A config from a table of the file; `where` is the table's name before its keys."""
    if not isinstance(data, dict):
        raise InputError(f"{where.rstrip('.')} must be a table")
    known = {each.name: each for each in fields(kind) if each.name not in given}
    hints = get_type_hints(kind)
    values = dict(given)
    for key, value in data.items():
        if key not in known:
            near = difflib.get_close_matches(key, known, n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"there are: {', '.join(known)}"
            raise InputError(f"unknown key {where + key!r}; {hint}")
        values[key] = _value(where + key, value, hints[key])
    missing = [
        name
        for name, each in known.items()
        if name not in values and each.default is MISSING and each.default_factory is MISSING
    ]
    if missing:
        raise InputError(f"{where + missing[0]!r} is missing")
    return kind(**values)


_SAID = {int: "a whole number", float: "a number", bool: "true or false"}


def _value(key: str, value: object, hint: Any) -> Any:
    """A value of the file as the type that the class names; one of several words is a string."""
    if get_origin(hint) is UnionType:
        (hint,) = set(get_args(hint)) - {NoneType}
    if get_origin(hint) is tuple:
        if not isinstance(value, list):
            raise InputError(f"{key} is {value!r}; it must be a list, as in [{value!r}]")
        return tuple(_value(key, each, get_args(hint)[0]) for each in value)
    wanted = hint if hint in _SAID else str
    if wanted is float and type(value) is int:
        value = float(value)
    if type(value) is not wanted:  # in Python, a bool is an int
        raise InputError(f"{key} is {value!r}; it must be {_SAID.get(wanted, 'a string')}")
    return Path(str(value)) if hint is Path else value
