"""The verbs of the `warp-deform` command that need the simulator alone."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from ..collecting.settings import CollectSettings, DemonstratorName
from ..errors import InputError
from ..gradcheck.config import GradcheckConfig
from ..quiet import quiet_warp
from ..robots import RobotName
from ..support.flag_range import COUNT, COUNT_OR_NONE, SEED, FlagRange
from ..tasks.registration import control_id, env_id
from ..tasks.registry import TASKS, all_tasks
from ..tasks.registry import task as find_task
from .main import CommandOptions, Outcome

__all__ = [
    "BenchOptions",
    "DemoOptions",
    "DoctorOptions",
    "GoalsOptions",
    "GradcheckOptions",
    "InspectOptions",
    "ListOptions",
    "ReplayOptions",
    "bench",
    "demo",
    "doctor",
    "goals",
    "gradcheck",
    "inspect",
    "list_tasks",
    "replay",
]

_Task = Annotated[Positional[str], arg(metavar="TASK")]
_Folder = Annotated[Positional[Path], arg(metavar="DIR")]
_Workers = Annotated[int | None, arg(metavar="W"), COUNT]


@dataclass(frozen=True, kw_only=True)
class ListOptions(CommandOptions):
    """List the tasks with their Gymnasium ids, goals, numbers of actions and objects.

    The benchmark's tasks come first, then others of this package, of installed packages, and of
    --task-module; last those that are only for control at 20 Hz.
    """


def list_tasks(options: ListOptions) -> Outcome:
    """The benchmark's tasks, in the paper's order, then the others, then those of control."""
    from ..control.registry import CONTROL_TASKS

    known, wrong = all_tasks()
    tasks: list[dict[str, Any]] = [
        {
            "name": name,
            "env_id": env_id(name),
            "goal_conditioned": task.goal_conditioned,
            "max_actions": task.max_actions,
            "objects": list(task.objects),
            "benchmark": name in TASKS,
        }
        for name, task in known.items()
    ]
    rows = [("task", "Gymnasium id", "benchmark", "goal", "actions", "objects")]
    for task in tasks:
        goal = "image" if task["goal_conditioned"] else "-"
        rows.append(
            (
                task["name"],
                task["env_id"],
                "yes" if task["benchmark"] else "-",
                goal,
                str(task["max_actions"]),
                ", ".join(task["objects"]),
            )
        )
    control: list[dict[str, Any]] = [
        {"name": name, "env_id": control_id(name), "objects": list(task.objects)}
        for name, task in CONTROL_TASKS.items()
    ]
    control_rows = [("control task", "Gymnasium id", "objects")] + [
        (task["name"], task["env_id"], ", ".join(task["objects"])) for task in control
    ]
    for line in wrong:
        print(f"warp-deform: warning: {line}", file=sys.stderr)
    return Outcome(
        data={"tasks": tasks, "control_tasks": control, "warnings": wrong},
        text=f"{_table(rows)}\n\n{_table(control_rows)}",
    )


@dataclass(frozen=True, kw_only=True)
class DemoOptions(CollectSettings, CommandOptions):
    """Collect successful demonstrations of a task. Attempts that fail are only counted."""

    verify: bool = False
    """After collecting, simulate all of them again; the exit code is 1 if any state differs."""


def demo(options: DemoOptions) -> Outcome:
    """Collect demonstrations into a folder."""
    if not options.control:
        find_task(options.task)
    from ..collecting.collect import CollectConfig, collect
    from ..collecting.control_demos import has_horizon

    quiet_warp()
    report = asdict(collect(options.configure(CollectConfig)))
    if report["enclosed"] is None:  # there are no items to enclose
        del report["enclosed"]
    failure = None
    if report["successes"] < options.episodes:
        failure = (
            f"{report['successes']} of {options.episodes} demonstrations succeeded in "
            f"{report['attempts']} attempts; ask for fewer or try another --seed"
        )
        if options.control and not report["successes"] and has_horizon(options.task):
            failure += ", or a longer --horizon"
    if options.verify and report["successes"]:
        from ..collecting.replay import verify

        report["mismatches"] = verify(options.out, workers=options.workers)["mismatches"]
        if report["mismatches"]:
            failure = f"{report['mismatches']} recorded states differ when simulated again"
    return Outcome(data=report, text=_lines(report), failure=failure)


@dataclass(frozen=True, kw_only=True)
class GoalsOptions(CommandOptions):
    """Make the goals that a goal-conditioned task is evaluated on."""

    task: _Task
    """Name of a goal-conditioned task."""
    count: Annotated[int, arg(name="goals", aliases=["-n"], metavar="N"), COUNT] = 20
    """How many goals to make. The paper evaluates on 20."""
    seed: Annotated[int, SEED] = 100_000
    """First seed. From 100,000 to 199,999 they are of tests; to learn with, take 200,000 and up."""
    out: Annotated[Path, arg(metavar="DIR")]
    """Folder for the goals."""
    kind: Literal["demonstrated", "constructed"] = "demonstrated"
    """Take the last states of demonstrations, as the paper does, or place objects at the goal."""
    demonstrator: DemonstratorName = "scripted"
    """Who demonstrates; `warp-deform demo --help` explains them."""
    workers: _Workers = None
    """Number of processes; by default one per core."""
    robot: RobotName = "ur5"
    """Which arm moves."""


def goals(options: GoalsOptions) -> Outcome:
    """Make a set of goals."""
    find_task(options.task)
    from ..collecting.make_goals import make_goals

    quiet_warp()
    report = make_goals(
        options.task,
        options.out,
        count=options.count,
        seed=options.seed,
        kind=options.kind,
        demonstrator=options.demonstrator,
        robot=options.robot,
        workers=options.workers,
    )
    failure = None
    if report["goals"] < options.count:
        failure = f"{report['goals']} of {options.count} goals were made; try another --seed"
    return Outcome(data=report, text=_lines(report), failure=failure)


@dataclass(frozen=True, kw_only=True)
class ReplayOptions(CommandOptions):
    """Simulate recorded episodes again, and compare the hash of every state."""

    folder: _Folder
    """Folder of episodes."""
    verify: bool = False
    """Fail with exit code 1 unless every state is the recorded one, bit for bit."""
    tolerance: Annotated[float | None, arg(metavar="M"), FlagRange(0.0, 1e3)] = None
    """Compare positions within this distance [m] and not bits, if the processor is another."""
    workers: _Workers = None
    """Number of processes; by default one per core, and fewer for few episodes."""


def replay(options: ReplayOptions) -> Outcome:
    """Simulate a folder's episodes again."""
    _check_folder(options.folder)
    from ..collecting.replay import verify

    quiet_warp()
    report = verify(options.folder, tolerance=options.tolerance, workers=options.workers)
    failure = None
    if options.verify and report["mismatches"]:
        failure = (
            f"{report['mismatches']} of {report['steps']} steps differ from the recording; on "
            "another kind of processor or version, compare with --tolerance 0.001"
        )
    return Outcome(data=report, text=_lines(report), failure=failure)


@dataclass(frozen=True, kw_only=True)
class InspectOptions(CommandOptions):
    """Show statistics of a folder of episodes, and draw each with its steps into a PNG."""

    folder: _Folder
    """Folder of episodes."""
    out: Annotated[Path | None, arg(metavar="DIR")] = None
    """Folder for the pictures; by default `DIR/sheets`."""
    sheets: Annotated[int, arg(metavar="N"), COUNT_OR_NONE] = 20
    """Draw at most so many episodes; 0 shows statistics alone."""


def inspect(options: InspectOptions) -> Outcome:
    """Look into a folder of episodes."""
    _check_folder(options.folder)
    from ..collecting.inspection import contact_sheet, statistics
    from ..episodes import EpisodeReader

    report = statistics(options.folder)
    reader = EpisodeReader(options.folder)
    out = options.out or options.folder / "sheets"
    paths = [
        out / reader.path(seed).with_suffix(".png").name for seed in reader.seeds[: options.sheets]
    ]
    if paths:
        _make_folder("--out", out)
    for seed, path in zip(reader.seeds, paths, strict=False):
        contact_sheet(reader.read(seed), path)
    shown = f"{len(paths)} of {len(reader)} episodes, in {out}"
    return Outcome(
        data={**report, "sheets": paths},
        text=_lines({**report, "sheets": shown}),
    )


@dataclass(frozen=True, kw_only=True)
class BenchOptions(CommandOptions):
    """Time one simulated second of a scene; compiling is timed apart."""

    scene: Literal[
        "cable", "heap", "ring", "block", "tower", "cloth10", "cloth25", "cloth50",
        "cloth10-edges", "cloth25-edges", "cloth50-edges", "bag", "bag-cube",
    ] = "cable"  # fmt: skip
    """What is simulated."""
    peer: Literal["pybullet", "mujoco", "newton-vbd", "newton-vbd-bodies", "newton-xpbd"] | None = (
        None
    )
    """Another simulator to time on the same scene."""


def bench(options: BenchOptions) -> Outcome:
    """Time the simulator."""
    from ..bench import run

    quiet_warp()
    report = run(scene=options.scene, peer=options.peer)
    return Outcome(data=report, text=_lines(report))


@dataclass(frozen=True, kw_only=True)
class GradcheckOptions(GradcheckConfig, CommandOptions):
    """Compare derivatives of the solver with finite differences, in states of real episodes."""

    task: Annotated[Positional[str | None], arg(metavar="[TASK]")] = None
    """Name of a task; left out, all."""
    summary: bool = False
    """One line per task and level instead of all rows."""


def gradcheck(options: GradcheckOptions) -> Outcome:
    """Check the adjoint."""
    if options.task is not None:
        find_task(options.task)
    from ..gradcheck.report import check, wrong
    from ..gradcheck.summary import summarise

    quiet_warp()
    rows, notes = check(options.task, options)
    table = [asdict(row) for row in (summarise(rows) if options.summary else rows)]
    head = tuple(key.replace("_", " ") for key in table[0]) if table else ()
    cells = [
        tuple(
            "-" if v is None else ", ".join(v) or "-" if isinstance(v, tuple) else _number(v)
            for v in row.values()
        )
        for row in table
    ]
    failure = None
    if not rows:
        failure = "no derivative was compared, the notes say why: ask for more, or other levels"
    elif missed := [f"{r.task}, {r.level}, by {r.parameter}" for r in wrong(rows)]:
        failure = f"derivatives miss the finite differences: {'; '.join(missed)}"
    return Outcome(
        data={"summary" if options.summary else "rows": table, "notes": notes},
        text="\n".join([*([_table([head, *cells])] if rows else []), *notes]),
        failure=failure,
    )


@dataclass(frozen=True, kw_only=True)
class DoctorOptions(CommandOptions):
    """Show versions, devices, caches, optional parts, and what this machine lacks."""


def doctor(options: DoctorOptions) -> Outcome:
    """Examine this machine and installation."""
    from .doctor import render, report

    quiet_warp()
    described = report()
    count = len(described["problems"])
    failure = (
        None if described["healthy"] else f"{count} problem{'s' * (count > 1)} found, see above"
    )
    return Outcome(data=described, text=render(described), failure=failure)


def _check_folder(folder: Path) -> None:
    if not folder.is_dir():
        raise InputError(f"no folder {str(folder)!r}; `warp-deform demo` makes one")


def _make_folder(flag: str, folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{flag} {folder} cannot be made: {error.strerror}") from error


def _lines(data: Mapping[str, Any]) -> str:
    """One `key  value` line an entry."""
    return _table([(key.replace("_", " "), _number(value)) for key, value in data.items()])


def _number(value: object) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_number(inner)}" for key, inner in value.items())
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _table(rows: Sequence[tuple[str, ...]]) -> str:
    """Rows of cells, in columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    )
