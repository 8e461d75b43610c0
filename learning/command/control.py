"""The verbs `train-control`, `eval-control` and `demo-control` of the `warp-deform` command."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from warp_deform.command.main import CommandOptions, Outcome
from warp_deform.errors import Interrupted
from warp_deform.quiet import quiet_warp
from warp_deform.support.flag_range import FlagRange
from warp_deform.support.progress import duration

from ..control.settings import ControlTrainSettings
from .outcome_text import interrupted, table

__all__ = [
    "ControlDemoOptions",
    "ControlEvalOptions",
    "ControlTrainOptions",
    "demo_control",
    "eval_control",
    "train_control",
]


@dataclass(frozen=True, kw_only=True)
class ControlTrainOptions(ControlTrainSettings, CommandOptions):
    """Train a policy of control at 20 Hz by gradients through the simulator, from nothing.

    No demonstrations are needed. After an interruption the same command continues. Without a
    terminal, a line on stderr reports the progress every 30 s.
    """


def train_control(options: ControlTrainOptions) -> Outcome:
    """Train a policy of control."""
    quiet_warp()
    from ..control import train
    from ..runs.folder import RunFolder

    try:
        report = asdict(train.train_control(options.configure(train.ControlTrainConfig)))
    except KeyboardInterrupt:
        kept = RunFolder(options.out).read_state()[1]
        raise Interrupted(interrupted(kept, unit="update")) from None
    return Outcome(data=report, text=_trained(report, options.out))


@dataclass(frozen=True, kw_only=True)
class ControlEvalOptions(CommandOptions):
    """Play the test seeds with the snapshot of a control run that was best on validation seeds."""

    run: Annotated[Positional[Path], arg(metavar="RUN")]
    """Folder that `train-control` made."""
    episodes: Annotated[int, arg(metavar="N"), FlagRange(1, 40_000)] = 200
    """Number of test episodes, with seeds 10,000 and up."""
    video: Annotated[Path | None, arg(metavar="FILE")] = None
    """Film the first two test episodes into this MP4."""


def eval_control(options: ControlEvalOptions) -> Outcome:
    """Test a control run."""
    quiet_warp()
    from ..control.evaluate import evaluate_control

    report = evaluate_control(options.run, episodes=options.episodes, video=options.video)
    return Outcome(data=report, text=_tested(report))


@dataclass(frozen=True, kw_only=True)
class ControlDemoOptions(CommandOptions):
    """Have the policy of a control run demonstrate: what it solves becomes a dataset at 20 Hz.

    It plays the seeds 0, 1, ... with the snapshot that was best on validation seeds. Each episode
    that is solved is written, without pictures. After an interruption the same command continues.
    """

    run: Annotated[Positional[Path], arg(metavar="RUN")]
    """Folder that `train-control` made."""
    episodes: Annotated[int, arg(aliases=["-n"], metavar="N"), FlagRange(1, 10_000)] = 100
    """Number of episodes to play."""
    out: Annotated[Path, arg(metavar="DIR")]
    """Folder for the dataset. Complete episodes in it are kept."""


def demo_control(options: ControlDemoOptions) -> Outcome:
    """Record what a control run's policy solves."""
    quiet_warp()
    from ..control.demonstrate import demonstrate

    report = asdict(demonstrate(options.run, options.out, episodes=options.episodes))
    text = (
        f"{report['out']}: {report['solved']} of {report['episodes']} episodes of "
        f"{report['task']} solved and recorded, mean score {report['mean_score']:.3f}, in "
        f"{report['seconds']:.1f} s"
    )
    return Outcome(data=report, text=text)


def _trained(report: Mapping[str, Any], out: Path) -> str:
    lines = {
        "run": str(out),
        "method": f"{report['method']} for {report['task']}, seed {report['seed']}",
        "updates": str(report["updates"]),
    }
    for step, each in report["validation"].items():
        lines[f"step {step}"] = (
            f"{each['n_success']} of {each['n_episodes']} validation episodes solved, mean score "
            f"{each['mean_score']:.3f}"
        )
    lines["chosen"] = f"step {report['chosen']}, by validation"
    lines["time"] = (
        f"{duration(report['cpu_seconds'])} of CPU for the updates, this call "
        f"{duration(report['seconds'])}"
    )
    lines["next"] = f"warp-deform eval-control {out}"
    return table(lines)


def _tested(report: Mapping[str, Any]) -> str:
    test = report["test"]
    (low, high), (least, most) = test["pc_success_ci95"], test["mean_score_ci95"]
    left = "no episode to its end" if test["mean_left"] is None else f"{test['mean_left']:.4f}"
    lines = {
        "task": report["task"],
        "method": f"{report['method']}, {report['updates']} updates, seed {report['seed']}",
        "snapshot": f"step {report['selected']}, chosen on validation seeds",
        "test": f"{test['n_success']} of {test['n_episodes']} episodes solved, "
        f"{test['pc_success']:.1f} % (95 % Wilson interval {low:.1f} to {high:.1f})",
        "mean score": f"{test['mean_score']:.4f} (95 % interval {least:.4f} to {most:.4f})",
        "mean left": f"{left}, the task's loss at the end",
    }
    if test["n_guards"]:
        lines["guards"] = f"{test['n_guards']} episodes, which count as not solved"
    return table(lines)
