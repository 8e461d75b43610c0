"""The verbs of the `warp-deform` command that train and evaluate."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from warp_deform.command.main import CommandOptions, Outcome
from warp_deform.errors import InputError, Interrupted
from warp_deform.quiet import quiet_warp
from warp_deform.support.flag_range import COUNT, SEED
from warp_deform.tasks.registry import task as find_task

from ..evaluation.settings import EvalSettings
from ..training.settings import TrainSettings

__all__ = [
    "EvalOptions",
    "ReportOptions",
    "SweepOptions",
    "TrainOptions",
    "evaluate",
    "report",
    "sweep",
    "train",
]

_Folder = Annotated[Positional[Path], arg(metavar="RUN")]


@dataclass(frozen=True, kw_only=True)
class TrainOptions(TrainSettings, CommandOptions):
    """Train an agent on demonstrations. After an interruption the same command continues.

    With --preset fast every snapshot plays validation episodes, and training ends when one solves
    them all. Without a terminal, a line on stderr reports the progress every 30 s.
    """

    no_augment: bool = False
    """Do not turn, shift or mirror pictures at random. (The paper turns and shifts them.)"""


def train(options: TrainOptions) -> Outcome:
    """Train an agent."""
    find_task(options.task)
    from ..runs.folder import RunFolder
    from ..training.config import TrainConfig
    from ..training.processes import rank
    from ..training.train import train as run_training
    from .outcome_text import interrupted, trained

    quiet_warp()
    config = options.configure(TrainConfig, augment=not options.no_augment)
    try:
        report = asdict(run_training(config))
    except KeyboardInterrupt:
        step = RunFolder(options.out).read_state()[1]
        raise Interrupted(interrupted(step)) from None
    if rank():
        raise SystemExit(0)  # under torchrun the first process speaks for all
    return Outcome(data=report, text=trained(report, out=options.out))


@dataclass(frozen=True, kw_only=True)
class EvalOptions(EvalSettings, CommandOptions):
    """Choose a run's best snapshot on validation seeds and play the test seeds with it.

    Goals are constructed from goal seeds unless given. Results are kept, and episodes that were
    played before, also in training, are not played again.
    """

    run: _Folder
    """Folder of a training run."""
    no_retry: bool = False
    """Do not let agents remember their last actions, and pick elsewhere after a miss. The paper's
    agents have no such memory."""
    first_seed: Annotated[int | None, arg(metavar="S"), SEED] = None
    """Play test episodes of seeds S and up instead of 10,000 and up. Their result is kept apart
    from that of the test seeds."""
    goals: Annotated[Path | None, arg(metavar="DIR")] = None
    """Folder of goals, see `warp-deform goals`. Test episodes use them in turn."""
    video: Annotated[Path | None, arg(metavar="DIR")] = None
    """Folder for an MP4 of each of the first test episodes: observation, goal, heat maps of pick
    and place, action, score."""
    videos: Annotated[int, arg(metavar="N"), COUNT] = 4
    """Largest number of videos."""
    no_video_arm: bool = False
    """Do not film the arm with --video. Pictures and heat maps alone take less time."""
    share: Annotated[Path | None, arg(metavar="DIR")] = None
    """New folder for a copy of the run to hand on: the chosen snapshot alone, in half its bytes."""
    workers: Annotated[int | None, arg(metavar="W"), COUNT] = None
    """Number of processes, by default one per core, and fewer for few episodes. It does not change
    the result."""


def evaluate(options: EvalOptions) -> Outcome:
    """Evaluate a training run."""
    from ..evaluation.run import evaluate_run
    from ..evaluation.share import share_run
    from .outcome_text import evaluated

    if options.share is not None and options.share.exists():
        raise InputError(f"--share {options.share} exists; name a folder to be made")
    quiet_warp()
    report = evaluate_run(
        options.run,
        **asdict(options.configure(EvalSettings)),
        retry=not options.no_retry,
        first_seed=options.first_seed,
        goals=options.goals,
        video=options.video,
        videos=options.videos,
        video_arm=not options.no_video_arm,
        workers=options.workers,
    )
    if options.share is not None:
        report["shared"] = str(share_run(options.run, options.share))
    return Outcome(data=report, text=evaluated(report))


@dataclass(frozen=True, kw_only=True)
class ReportOptions(CommandOptions):
    """Tables and learning curves of evaluated runs, with the paper's numbers beside them.

    Runs that differ only in their seed are pooled.
    """

    runs: Annotated[Positional[tuple[Path, ...]], arg(metavar="RUNS")]
    """Folders of training runs, or folders that hold some."""
    out: Annotated[Path | None, arg(metavar="DIR")] = None
    """Folder for report.md, report.csv, report.tex, runs.csv and the curves. Without it only the
    text is shown."""


def report(options: ReportOptions) -> Outcome:
    """Report evaluated runs."""
    if not options.runs:
        raise InputError("no run is named; name folders that `warp-deform train` made with --out")
    from ..report.report import write_report

    written = write_report(options.runs, options.out)
    return Outcome(data=written.data, text=written.text)


@dataclass(frozen=True, kw_only=True)
class SweepOptions(CommandOptions):
    """Train and evaluate a grid of tasks, agents, numbers of demonstrations and seeds.

    What is done is skipped, so the same command goes on where it was interrupted. Demonstrations
    are collected where they are missing.
    """

    file: Annotated[Positional[Path], arg(metavar="FILE.toml")]
    """The grid; see docs/learning.md."""
    workers: Annotated[int | None, arg(metavar="W"), COUNT] = None
    """Processes; left out, one per core, or the cluster's cores. Each trains with one thread."""
    ray: Annotated[str | None, arg(metavar="ADDRESS")] = None
    """Address of a Ray cluster to work on (needs the extra `ray`)."""


def sweep(options: SweepOptions) -> Outcome:
    """Run a grid."""
    from ..sweep import read_sweep, run_sweep

    config = read_sweep(options.file)
    quiet_warp()
    outcome = run_sweep(config, workers=options.workers, ray=options.ray)
    failure = None
    if outcome["failed"]:
        first = outcome["failed"][0]
        failure = (
            f"{len(outcome['failed'])} of {outcome['runs']} runs failed; first {first['run']}: "
            f"{first['error']}"
        )
    done = outcome["runs"] - len(outcome["failed"])
    text = f"{done} of {outcome['runs']} runs are done, {outcome['skipped']} were before"
    if outcome["report"] is not None:
        text += f"; tables and curves: {outcome['report']}"
    return Outcome(data=outcome, text=text, failure=failure)
