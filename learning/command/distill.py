"""The verb `distill` of the `warp-deform` command."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from warp_deform.command.main import CommandOptions, Outcome
from warp_deform.quiet import quiet_warp
from warp_deform.tasks.registry import task as find_task

from ..distillation.settings import DistillSettings

__all__ = ["DistillOptions", "distill"]


@dataclass(frozen=True, kw_only=True)
class DistillOptions(DistillSettings, CommandOptions):
    """Make the best policy that a budget of CPU minutes allows, from nothing, and test it.

    A teacher demonstrates, an agent learns, plays and is corrected, round by round; validation
    chooses the snapshot. The same command goes on where it was stopped.
    """


def distill(options: DistillOptions) -> Outcome:
    """Distill a policy."""
    find_task(options.task)
    from ..distillation.distill import DistillConfig
    from ..distillation.distill import distill as distill_policy

    quiet_warp()
    report = distill_policy(options.configure(DistillConfig))
    return Outcome(data=report, text=_text(report))


def _text(report: Mapping[str, Any]) -> str:
    test = report["test"]
    low, high = test["pc_success_ci95"]
    rounds = [each for each in report["stages"] if each["stage"].startswith("correction")]
    solved = ", ".join(f"{each['solved']} of {each['corrected']}" for each in rounds)
    lines = {
        "policy": f"{report['run']}, step {report['selected']}, chosen on validation seeds",
        "agent": f"{report['agent']} for {report['task']}, taught by {report['teacher']}",
        "learnt from": f"{report['demos']} demonstrations and {report['corrected']} corrected "
        f"episodes, {report['labels']} labels in all",
        "corrected": f"the policy solved {solved}, round by round, on seeds new to it",
        "cost": f"{report['cpu_minutes']:.1f} CPU minutes, of a budget of {report['minutes']:g}, "
        f"and {report['test_cpu_minutes']:.1f} for the test",
        "test": f"{test['n_success']} of {test['n_episodes']} episodes solved, "
        f"{test['pc_success']:.1f} % (95 % Wilson interval {low:.1f} to {high:.1f})",
        "mean score": f"{test['mean_score']:.4f}",
        "mean actions": f"{test['mean_actions']:.2f}",
    }
    width = max(map(len, lines))
    return "\n".join(f"{key:<{width}}  {value}" for key, value in lines.items())
