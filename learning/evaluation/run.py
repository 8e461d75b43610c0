"""A training run's evaluation: every snapshot on validation seeds, the chosen one on test seeds.

The paper's own protocol, the best of ten snapshots on the test seeds themselves, is a second,
labelled result: it is optimistic.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Literal

import joblib

from warp_deform.collecting.goals import check_goals
from warp_deform.collecting.workers import worker_count
from warp_deform.episodes import EpisodeReader, combine_hashes
from warp_deform.errors import InputError
from warp_deform.support.progress import progress_bar
from warp_deform.support.revision import running_revision
from warp_deform.tasks.registration import env_id

from ..policy.policy import load_policy
from ..runs.folder import RunFolder, write_json
from ..runs.log import cpu_seconds, read_log
from .paper_results import PARTIAL_SCORE, SUCCESS, partial_credit, read_paper
from .protocol import FIRST_SEED, Protocol, check_splits
from .snapshot import confirmed, evaluate_snapshot, trained_steps
from .summary import Evaluation, PlayedEpisode, best

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
    first_seed: int | None = None,
    video: Path | None = None,
    videos: int = 4,
    video_arm: bool = True,
    workers: int | None = None,
    progress: bool = True,
) -> dict[str, Any]:
    """Choose the best snapshot on validation seeds, and play the test seeds with it.

    Writes `eval_info.json` into the run's folder and returns what it says: task, agent, preset,
    steps (planned), trained_steps (fewer where training stopped early), demos, seed, stage_rule,
    retry, robot, goals, seconds [s]; `snapshots`: by step, results on validation seeds;
    `selected`: the step chosen; `test`: its results on test seeds; `paper`: None, or the best of
    the snapshots' results by the paper's protocol, and in its `snapshots` all of them by step.
    Step 0, the untrained network, is played for the learning curve and never chosen; `videos`:
    paths, where asked for; `environment`: the task's Gymnasium id, whose version rises with its
    physics and rules; `measure`: what the paper's table shows for the task, and `published`:
    its number [%], None where it has none; `revision`: what evaluated; `training_cpu_seconds`.
    See `summary.summarise` for a result's keys.

    `other_seeds`: by first seed, what was played with `first_seed`: `first_seed`, `selected`,
    `test`, `paper` and the settings that may differ from those above. Such a call changes nothing
    else of an earlier evaluation (without one, `test` is None), and returns its own as `played`
    too.

    By the paper's protocol its hidden rule chooses the lift where a task has several, which
    `stage_rule` of `paper` says, and an action that the arm cannot carry out ends an episode.

    Args:
        path: folder of the run
        episodes: test episodes
        validation_episodes: of every snapshot
        paper: also evaluate by the paper's protocol
        stage_rule: who chooses the lift, see `EvalSettings`
        retry: whether an agent remembers what it missed, and picks elsewhere
        robot: the arm
        goals: folder of goals for the test episodes; None: constructed from goal seeds
        first_seed: of other test episodes; their results are kept apart
        video: folder for videos of the first `videos` test episodes
        videos: at most so many
        video_arm: also with the arm
        workers: processes; None: one a core, and fewer for few episodes
        progress: tell of it on stderr, see `warp_deform.support.progress`

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

    def evaluate(what: str, of: Sequence[int], protocol: Protocol) -> list[Evaluation]:
        count = workers or max(1, min(joblib.cpu_count(), protocol.episodes // _LEAST_EPISODES))
        total, evaluations = len(of) * protocol.episodes, []
        with progress_bar(f"eval {task}, {what}", total, shown=progress) as advance:
            for step in of:
                solved: list[bool] = []

                def on_episode(
                    played: PlayedEpisode, step: int = step, solved: list[bool] = solved
                ) -> None:
                    solved.append(played.success)
                    advance()
                    advance.note = f"step {step}: {sum(solved)} of {len(solved)} solved"

                evaluations.append(
                    evaluate_snapshot(run, step, protocol, workers=count, on_episode=on_episode)
                )
        return evaluations

    validation = Protocol(
        split="validation",
        episodes=validation_episodes,
        stage_rule=stage_rule,
        retry=retry,
        robot=robot,
    )
    if first_seed == FIRST_SEED["test"]:
        first_seed = None
    test = replace(
        validation, split="test", episodes=episodes, goal_folder=goals, first_seed=first_seed
    )
    if goals is not None:  # a wrong folder is told of before anything is played
        check_goals(goals, task)
    lifts = settings["agent"]["config"].get("lifts")
    several = isinstance(lifts, list) and len(lifts) > 1
    paper_protocol = replace(
        test,
        episodes=_PAPER_EPISODES,
        goals="demonstrated",
        n_goals=_PAPER_EPISODES,
        goal_folder=None,
        stage_rule="privileged" if several else stage_rule,
        retry=False,
        motions_must_succeed=True,
    )
    planned = [validation, test, paper_protocol] if paper else [validation, test]
    learnt = settings.get("goal_seeds", ())
    check_splits(map(int, settings["demonstrations"]), planned, task=task, goals=learnt)
    for step in steps:  # a damaged one is told of before anything is played
        load_policy(run.snapshot(step))
    if video is not None and video.exists() and not video.is_dir():
        raise InputError(f"{video} is no folder; name one for the videos")
    earlier = _earlier(run)
    validated = evaluate("validation", steps, validation)
    further = {step: confirmed(run, step, validation) for step in steps}
    chosen = best([each for each in validated if each.step], task=task, confirmed=further)
    (result,) = evaluate("test", [chosen.step], test)
    paper_table = read_paper()
    demos, agent = len(settings["demonstrations"]), settings["agent"]["agent"]
    report: dict[str, Any] = {
        "task": task,
        "environment": env_id(task),
        "agent": agent,
        "preset": settings["preset"],
        "steps": settings["schedule"]["steps"],
        "trained_steps": trained,
        "demos": demos,
        "seed": settings["seed"],
        "stage_rule": stage_rule,
        "retry": retry,
        "robot": robot,
        "goals": _named(goals),
        "snapshots": {str(e.step): {"split": "validation", **e.summary} for e in validated},
        "selected": chosen.step,
        "test": result.summary,
        "paper": None,
        "measure": PARTIAL_SCORE if partial_credit(task) else SUCCESS,
        "published": paper_table.values.get((task, agent, demos)),
        "revision": asdict(running_revision()),
        "training_cpu_seconds": cpu_seconds(read_log(run)),
        "other_seeds": earlier.get("other_seeds", {}),
    }
    if paper:
        played = evaluate("paper's protocol", steps, paper_protocol)
        top = best([each for each in played if each.step], task=task)
        report["paper"] = {
            "protocol": "best of the snapshots on the test seeds themselves (optimistic)",
            "stage_rule": paper_protocol.stage_rule,
            "n_snapshots": sum(step > 0 for step in steps),
            "snapshot": top.step,
            **top.summary,
            "snapshots": {str(e.step): {"split": "test", **e.summary} for e in played},
        }
    report["seconds"] = time.perf_counter() - began
    stored = report if first_seed is None else _beside(earlier, report, first_seed)
    write_json(run.report, stored)  # before films, which may fail
    if video is not None:
        from .video import film_episodes

        count = min(videos, episodes)
        paths = film_episodes(run, result, test, video, count=count, arm=video_arm)
        stored = {**stored, "videos": [str(path) for path in paths]}
        write_json(run.report, stored)
    if first_seed is None:
        return stored
    return {**stored, "played": stored["other_seeds"][str(first_seed)]}


_OWN = ("stage_rule", "retry", "robot", "goals", "selected", "test", "paper", "revision", "seconds")
"""What results on other seeds have of their own."""


def _beside(
    earlier: Mapping[str, Any], report: Mapping[str, Any], first_seed: int
) -> dict[str, Any]:
    """An earlier evaluation, or one without a test, with results on other seeds beside it."""
    combined = dict(earlier) or {**report, "test": None, "paper": None}
    played = {"first_seed": first_seed, **{key: report[key] for key in _OWN}}
    combined["other_seeds"] = {**report["other_seeds"], str(first_seed): played}
    return combined


def _earlier(run: RunFolder) -> dict[str, Any]:
    """An earlier evaluation; nothing where there is none, or one that cannot be read any more."""
    try:
        return run.read_report() if run.report.is_file() else {}
    except InputError:
        return {}


def _named(goals: Path | None) -> str:
    """Whose goals the test episodes had."""
    if goals is None:
        return "constructed"
    return f"given, {combine_hashes(info.state_hash for info in EpisodeReader(goals).infos())[:12]}"
