"""What `train` and `eval` print for people; programs read the JSON, which rounds nothing."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from warp_deform.support.progress import duration

__all__ = ["evaluated", "interrupted", "table", "trained"]

_LIFT = {"action": "the policy", "privileged": "the paper's rule, which reads the simulator"}


def interrupted(step: int, *, unit: str = "step") -> str:
    """What an interruption of `train` leaves, by the step of the state that is stored."""
    if not step:
        return f"no {unit} is kept yet, the same command begins again"
    return f"{unit}s up to {step} are kept, the same command goes on and ends with the same bits"


def trained(report: Mapping[str, Any], *, out: Path) -> str:
    """What `train` came to: the fields of `train.TrainReport` and the folder."""
    steps, planned = report["steps"], report["planned_steps"]
    outcomes = report["agent"] == "traced"  # it learns from what was done, and errs by distances
    unit = "" if outcomes else " nat"
    learnt = f"{report['labels']} {'actions' if outcomes else 'labels'} in all"
    lines = {
        "run": str(out),
        "agent": f"{report['agent']} for {report['task']}, preset {report['preset']}, seed "
        f"{report['seed']}",
        "learnt from": _count(report["demos"], "demonstration"),
        "steps": f"{steps}, as planned" if steps == planned else f"{steps} of up to {planned}",
    }
    if report["corrected"]:
        lines["learnt from"] = (
            f"{_count(report['demos'] - report['corrected'], 'demonstration')} and "
            f"{_count(report['corrected'], 'corrected episode')}, {learnt}"
        )
    if report["left_out"]:
        lines["learnt from"] += f"; {_count(report['left_out'], 'recording')} left out as none"
    validation = report["validation"]
    if report["stopped_early"] and validation:
        last = validation[max(validation)]
        lines["steps"] += ": " + (
            "a snapshot solved every validation episode"
            if last["n_success"] == last["n_episodes"]
            else f"{_count(report['patience'], 'snapshot')} in a row brought nothing better"
        )
    for step, each in validation.items():
        lines[f"step {step}"] = (
            f"{each['n_success']} of {each['n_episodes']} validation episodes solved, mean score "
            f"{each['mean_score']:.3f}"
        )
    if report["chosen"] is not None:
        lines["chosen"] = f"step {report['chosen']}, by validation"
    for step, loss in report["held_out"].items():
        lines[f"step {step}"] = f"loss {loss:.3f}{unit} on demonstrations that were held out"
    if report["loss"] is not None:
        lines["loss"] = f"{report['loss']:.3f}{unit} over the last logged steps"
    lines["time"] = (
        f"{duration(report['cpu_seconds'])} of CPU for the steps, this call "
        f"{duration(report['seconds'])}"
    )
    lines["next"] = f"warp-deform eval {out}"
    return table(lines)


def evaluated(report: Mapping[str, Any]) -> str:
    """What `eval` came to, see `evaluate_run`; with other seeds what those came to."""
    other = report.get("played")
    test = report["test"] if other is None else other["test"]
    low, high = test["pc_success_ci95"]
    lines = {
        "task": report["task"],
        "agent": f"{report['agent']}, {_count(report['demos'], 'demonstration')}, seed "
        f"{report['seed']}",
        "snapshot": f"step {report['selected'] if other is None else other['selected']}, chosen on "
        "validation seeds",
        "test": f"{test['n_success']} of {test['n_episodes']} episodes solved, "
        f"{test['pc_success']:.1f} % (95 % Wilson interval {low:.1f} to {high:.1f})",
        "mean score": f"{test['mean_score']:.4f}",
        "mean actions": f"{test['mean_actions']:.2f}",
    }
    if other is not None:
        last = other["first_seed"] + test["n_episodes"] - 1
        lines["seeds"] = f"{other['first_seed']} to {last}, kept apart from the test seeds"
    lines["compared"] = _compared(test, report)
    if test["n_success_enclosed"] is not None:
        lines["enclosed"] = f"{test['n_success_enclosed']} of the solved kept all items in the bag"
    if test["failures"]:
        lines["failures"] = ", ".join(f"{name} {n}" for name, n in test["failures"].items())
    paper = report["paper"] if other is None else other["paper"]
    if paper is not None:
        lines["paper's way"] = (
            f"ours {paper['paper_value']:.1f} %, best of {_count(paper['n_snapshots'], 'snapshot')}"
            f" on {paper['n_episodes']} test episodes themselves (optimistic), lift by "
            + _LIFT[paper["stage_rule"]]
        )
    if "videos" in report:
        lines["videos"] = ", ".join(report["videos"])
    if "shared" in report:
        lines["shared"] = report["shared"]
    return table(lines)


def _compared(test: Mapping[str, Any], report: Mapping[str, Any]) -> str:
    """Our result by the measure that the paper's table has for the task, and its number."""
    ours = f"{report['measure']}: ours {test['paper_value']:.1f} %, "
    if report["published"] is None:
        return ours + f"the paper has no number for {_count(report['demos'], 'demonstration')}"
    return ours + f"the paper's {report['published']:.1f} % (in another simulator)"


def _count(number: int, what: str) -> str:
    return f"{number} {what}" + "s" * (number != 1)


def table(data: Mapping[str, str]) -> str:
    """Lines of a name and what is said of it, one below the other."""
    width = max(map(len, data))
    return "\n".join(f"{key:<{width}}  {value}" for key, value in data.items())
