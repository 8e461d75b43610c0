"""A run's results: every snapshot on validation seeds, the chosen one on test seeds."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import joblib
from rich.console import Console
from rich.progress import track

from warp_deform.errors import InputError

from .evaluation import Evaluation, Protocol, best, evaluate_snapshot
from .snapshots import RunFolder, write_json

__all__ = ["evaluate_run"]

_LEAST_EPISODES = 8
"""By default each process gets at least so many episodes: one group of SIMD lanes."""
_PAPER_EPISODES = 20


def evaluate_run(
    path: Path,
    *,
    episodes: int,
    validation_episodes: int = 20,
    paper: bool = False,
    stage_rule: Literal["action", "privileged"] = "action",
    retry: bool = True,
    robot: str = "ur5",
    workers: int | None = None,
) -> dict[str, Any]:
    """Choose the best snapshot on validation seeds, and play the test seeds with it.

    Writes `eval_info.json` into the run's folder and returns what it says: task, agent, preset,
    demos, seed, stage_rule, retry, robot, seconds [s]; `snapshots`: by step, results on validation
    seeds; `selected`: the step chosen; `test`: its results on test seeds; `paper`: None, or the
    best of the snapshots' results by the paper's protocol. See `evaluation.summarise` for a
    result's keys.

    Raises:
        InputError: this is no finished run.
    """
    began = time.perf_counter()
    run = RunFolder(path)
    settings, steps = run.read_settings(), run.steps()
    if not steps:
        raise InputError(f"{run.path} has no snapshot yet; run `warp-deform train` to its end")
    task = settings["agent"]["task"]

    def play(step: int, protocol: Protocol) -> Evaluation:
        count = workers or max(1, min(joblib.cpu_count(), protocol.episodes // _LEAST_EPISODES))
        return evaluate_snapshot(run, step, protocol, workers=count)

    validation = Protocol(
        split="validation",
        episodes=validation_episodes,
        stage_rule=stage_rule,
        retry=retry,
        robot=robot,
    )
    test = replace(validation, split="test", episodes=episodes)
    validated = [play(step, validation) for step in _progress(steps, "validation")]
    chosen = best(validated, task=task)
    result = play(chosen.step, test)
    report: dict[str, Any] = {
        "task": task,
        "agent": settings["agent"]["agent"],
        "preset": settings["preset"],
        "demos": len(settings["demonstrations"]),
        "seed": settings["seed"],
        "stage_rule": stage_rule,
        "retry": retry,
        "robot": robot,
        "snapshots": {str(e.step): {"split": "validation", **e.summary} for e in validated},
        "selected": chosen.step,
        "test": result.summary,
        "paper": None,
    }
    if paper:
        theirs = replace(
            test,
            episodes=_PAPER_EPISODES,
            goals="demonstrated",
            n_goals=_PAPER_EPISODES,
            retry=False,
        )
        played = [play(step, theirs) for step in _progress(steps, "paper's protocol")]
        top = best(played, task=task)
        report["paper"] = {
            "protocol": "best of the snapshots on the test seeds themselves (optimistic)",
            "n_snapshots": len(steps),
            "snapshot": top.step,
            **top.summary,
        }
    report["seconds"] = time.perf_counter() - began
    write_json(run.report, report)
    return report


def _progress(steps: list[int], name: str) -> Any:
    """The steps, with a bar on stderr while somebody looks at it."""
    console = Console(stderr=True)
    return track(steps, name, console=console, transient=True, disable=not console.is_terminal)
