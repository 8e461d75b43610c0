"""A run's results: every snapshot on validation seeds, the chosen one on test seeds."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import joblib

from warp_deform.episodes import EpisodeReader, combine_hashes
from warp_deform.progress import progress_bar
from warp_deform.workers import worker_count

from .evaluation import Evaluation, best, evaluate_snapshot, trained_steps
from .protocol import Protocol, check_goals, check_splits
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
    goals: Path | None = None,
    video: Path | None = None,
    videos: int = 4,
    workers: int | None = None,
    progress: bool = True,
) -> dict[str, Any]:
    """Choose the best snapshot on validation seeds, and play the test seeds with it.

    goals: folder of goals for the test episodes; None: constructed from goal seeds
    video: folder for videos of the first `videos` test episodes
    progress: show bars on a terminal

    Writes `eval_info.json` into the run's folder and returns what it says: task, agent, preset,
    steps (planned), trained_steps (fewer where training stopped early), demos, seed, stage_rule,
    retry, robot, goals, seconds [s]; `snapshots`: by step, results on validation seeds;
    `selected`: the step chosen; `test`: its results on test seeds; `paper`: None, or the best of
    the snapshots' results by the paper's protocol, and in its `snapshots` all of them by step.
    Step 0, the untrained network, is played for the learning curve and never chosen; `videos`:
    paths, where asked for. See `evaluation.summarise` for a result's keys.

    By the paper's protocol its hidden rule chooses the lift where a task has several, which
    `stage_rule` of `paper` says.

    Raises:
        InputError: this is no finished run, a seed of it is to be played, a file is damaged, or
            there are too many workers.
    """
    began = time.perf_counter()
    run = RunFolder(path)
    settings, trained, steps = run.read_settings(), trained_steps(RunFolder(path)), run.steps()
    task = settings["agent"]["task"]
    if workers is not None:
        workers = worker_count(workers, episodes)

    def play(step: int, protocol: Protocol) -> Evaluation:
        count = workers or max(1, min(joblib.cpu_count(), protocol.episodes // _LEAST_EPISODES))
        return evaluate_snapshot(run, step, protocol, workers=count)

    def play_all(what: str, protocol: Protocol) -> list[Evaluation]:
        found = []
        with progress_bar(what, len(steps), shown=progress) as advance:
            for step in steps:
                found.append(play(step, protocol))
                advance()
        return found

    validation = Protocol(
        split="validation",
        episodes=validation_episodes,
        stage_rule=stage_rule,
        retry=retry,
        robot=robot,
    )
    test = replace(validation, split="test", episodes=episodes, goal_folder=goals)
    if goals is not None:  # a wrong folder is told of before anything is played
        check_goals(goals, task)
    lifts = settings["agent"]["config"].get("lifts")
    several = isinstance(lifts, list) and len(lifts) > 1
    theirs = replace(
        test,
        episodes=_PAPER_EPISODES,
        goals="demonstrated",
        n_goals=_PAPER_EPISODES,
        goal_folder=None,
        stage_rule="privileged" if several else stage_rule,
        retry=False,
    )
    planned = [validation, test, theirs] if paper else [validation, test]
    check_splits(map(int, settings["demonstrations"]), planned, task=task)
    validated = play_all("validation", validation)
    chosen = best([each for each in validated if each.step], task=task)
    result = play(chosen.step, test)
    report: dict[str, Any] = {
        "task": task,
        "agent": settings["agent"]["agent"],
        "preset": settings["preset"],
        "steps": settings["schedule"]["steps"],
        "trained_steps": trained,
        "demos": len(settings["demonstrations"]),
        "seed": settings["seed"],
        "stage_rule": stage_rule,
        "retry": retry,
        "robot": robot,
        "goals": _named(goals),
        "snapshots": {str(e.step): {"split": "validation", **e.summary} for e in validated},
        "selected": chosen.step,
        "test": result.summary,
        "paper": None,
    }
    if paper:
        played = play_all("paper's protocol", theirs)
        top = best([each for each in played if each.step], task=task)
        report["paper"] = {
            "protocol": "best of the snapshots on the test seeds themselves (optimistic)",
            "stage_rule": theirs.stage_rule,
            "n_snapshots": sum(step > 0 for step in steps),
            "snapshot": top.step,
            **top.summary,
            "snapshots": {str(e.step): {"split": "test", **e.summary} for e in played},
        }
    if video is not None:
        from .film import film_episodes

        count = min(videos, episodes)
        report["videos"] = [str(p) for p in film_episodes(run, result, test, video, count=count)]
    report["seconds"] = time.perf_counter() - began
    write_json(run.report, report)
    return report


def _named(goals: Path | None) -> str:
    """Whose goals the test episodes had."""
    if goals is None:
        return "constructed"
    return f"given, {combine_hashes(info.state_hash for info in EpisodeReader(goals).infos())[:12]}"
