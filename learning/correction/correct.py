"""Corrected episodes (DAgger): what a policy runs into, with what a teacher would have done there.

A policy that learned from demonstrations meets states that no demonstrator would have come to. Here
it plays, and in every state a teacher that sees the simulator is asked for its action, which is not
carried out. The labelled episodes stand in one folder with what the policy learned from, so that
the next training learns from both. An episode depends on the policy, the teacher, its seed and,
where goals are given, its goal alone.

Source: Ross et al., AISTATS 2011.
"""

from __future__ import annotations

import hashlib
import math
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from warp_deform.collecting.folder import Attempt, Collection, append_attempt, check_seeds
from warp_deform.collecting.goals import check_goals, goals_in_turn, load_goals
from warp_deform.collecting.recording import observe, record
from warp_deform.collecting.workers import Workers, worker_count
from warp_deform.episodes import (
    Episode,
    EpisodeInfo,
    EpisodeReader,
    EpisodeWriter,
    Step,
    combine_hashes,
    episode_name,
    read_index,
    rebuild_index,
)
from warp_deform.episodes.corrected import correction, corrector, is_corrected, labels_of
from warp_deform.errors import InputError
from warp_deform.planning.demonstrators import demonstrator
from warp_deform.rendering.pixels import SHAPE
from warp_deform.robots import robot as find_robot
from warp_deform.support.progress import progress_bar
from warp_deform.support.whole_file import whole_file
from warp_deform.tasks.registry import task as find_task
from warp_deform.tasks.task import Action, Task
from warp_deform.worlds.loop import EpisodeRun, play, worlds_for
from warp_deform.worlds.worlds import Worlds

from ..data.batches import task_lifts
from ..data.dataset import LearntGoal, check_learnt_goals
from ..data.goals import check_goals_are_given, making_goals, refuse_test_goal
from ..evaluation.play import acting
from ..evaluation.protocol import Protocol, check_splits
from ..evaluation.snapshot import trained_steps
from ..policy.policy import AGENTS, load_policy
from ..runs.folder import RunFolder
from .settings import CorrectSettings

__all__ = ["CorrectConfig", "CorrectReport", "correct"]

_COLLECTED = 16
"""A corrected episode takes as long as collecting so many: four are worth a second process."""
_CHUNK = 16
_LIFT_GAP = 1e-6


@dataclass(frozen=True, kw_only=True)
class CorrectConfig(CorrectSettings):
    """The settings of a correction, checked."""

    def __post_init__(self) -> None:
        if self.episodes < 1:
            raise InputError(f"episodes is {self.episodes}; it must be 1 or more")
        demonstrator(self.teacher)
        find_robot(self.robot)


@dataclass(frozen=True)
class CorrectReport:
    """What came of it.

    Attributes:
        episodes: that the policy played
        corrected: of these, the ones that are kept; without those whose physics failed, and those
            in which the teacher had nothing to say that an agent can learn
        solved: of these, the ones that the policy solved
        mean_score: of the corrected episodes' ends
        labels: of the corrected episodes together
        before: demonstrations, and episodes corrected before, that the folder also holds
        before_labels: actions, or labels, of these
        equal_demonstrations: demonstrations of the folder that hold as many actions as there are
            new labels; None where the folder holds no demonstration
        state_hash: of all episodes in the folder in the order of their seeds
        seconds: what this run took [s]
    """

    task: str
    teacher: str
    out: str
    episodes: int
    corrected: int
    solved: int
    mean_score: float
    labels: int
    before: int
    before_labels: int
    equal_demonstrations: float | None
    state_hash: str
    seconds: float


def correct(config: CorrectConfig) -> CorrectReport:
    """Correct a policy into a folder; goes on where an earlier run of the same was interrupted.

    Raises:
        InputError: there is no finished run, what it learned from is not there, the teacher has
            nothing to say of its task, a seed is needed elsewhere, a goal is one of tests, goals
            have to be given, or the folder holds something else.
    """
    began = time.perf_counter()
    goals = None if config.goals is None else Path(config.goals).resolve()
    config = replace(config, out=Path(config.out).resolve(), goals=goals)
    out, run = config.out, RunFolder(config.run)
    settings = run.read_settings()
    trained_steps(run)  # refuses a run that has not come to its end
    task, known = settings["agent"]["task"], sorted(map(int, settings["demonstrations"]))
    source = _source(config, settings)
    if source == out:
        raise InputError(f"{config.out} is what {config.run} learned from; give --out another one")
    seeds = _seeds(config, known, task)
    _check_goals(config, task, seeds)
    follows = AGENTS[settings["agent"]["agent"]].sees == "traces"
    learnt: LearntGoal = "played" if follows else settings.get("goal", "end")
    check_learnt_goals(EpisodeReader(source), known, find_task(task), goal=learnt)
    snapshot = run.chosen_snapshot().resolve()
    load_policy(snapshot)  # refuses a damaged one before anything is made
    weights = hashlib.blake2b(snapshot.read_bytes(), digest_size=16).hexdigest()
    _check_teacher(config, task, seeds[0])
    description = {
        "corrected": weights,
        "teacher": config.teacher,
        "robot": config.robot,
        "seed": seeds[0],
        "demonstrations": settings["demonstrations"],
    }
    if config.goals is not None:
        infos = EpisodeReader(config.goals).infos()
        description["goals"] = [info.state_hash for info in infos]
    count = worker_count(config.workers, _COLLECTED * len(seeds))
    with Collection(out, description).owned() as collection:
        _copy(source, out, known)
        todo = [seed for seed in seeds if seed not in collection.attempts]
        size = max(1, min(_CHUNK, math.ceil(len(todo) / count)))
        chunks = [
            _Chunk(config, snapshot, weights, tuple(todo[i : i + size]))
            for i in range(0, len(todo), size)
        ]
        bar = progress_bar(f"correct {task}", len(seeds), done=len(seeds) - len(todo))
        with Workers(min(count, max(1, len(chunks)))) as crew, bar as advance:
            for attempt in crew.run(_correct_chunk, chunks):
                collection.attempts[attempt.seed] = attempt
                advance()
        collection.keep({*known, *seeds})
    rebuild_index(out)
    return _report(config, out, set(seeds), time.perf_counter() - began)


def _source(config: CorrectConfig, settings: Mapping[str, Any]) -> Path:
    """Folder of what the run learned from.

    Raises:
        InputError: it is not there, or holds other episodes under the same names.
    """
    named = config.data or (Path(settings["data"]) if settings.get("data") else None)
    if named is None:
        raise InputError(f"{config.run} does not name what it learned from; give it by --data")
    try:
        index = read_index(named)["episodes"]
    except InputError as error:
        raise InputError(f"{error} (what {config.run} learned from; --data names it)") from error
    for seed, seal in settings["demonstrations"].items():
        if index.get(episode_name(int(seed)), {}).get("seal") != seal:
            raise InputError(
                f"{named} does not hold the episode of seed {seed} that {config.run} learned from; "
                "name the folder that does by --data"
            )
    return named.resolve()


def _seeds(config: CorrectConfig, known: Sequence[int], task: str) -> range:
    """Seeds of the episodes to play, which nothing else uses.

    Raises:
        InputError: one is learned from already, or is of validation, test or goals.
    """
    first = known[-1] + 1 if config.seed is None else config.seed
    check_seeds(first, config.episodes)
    seeds = range(first, first + config.episodes)
    both = next((seed for seed in known if seed in seeds), None)
    if both is not None:
        raise InputError(
            f"seed {both} is one that {config.run} learned from; give --seed a greater one"
        )
    protocols = [Protocol(split="validation", episodes=20), Protocol(split="test", episodes=200)]
    check_splits(seeds, protocols, task=task)
    return seeds


def _check_goals(config: CorrectConfig, task: str, seeds: Sequence[int]) -> None:
    """Refuse goals that an agent should not learn with, before anything is made.

    Raises:
        InputError: one is of tests, the folder holds none of the task, or none are given where
            starts make goals that show what those of tests do not.
    """
    known = find_task(task)
    making = f"(`{making_goals(known)}`)"
    check_goals_are_given(
        known, given=config.goals is not None, advice=f"give goals by --goals {making}"
    )
    if config.goals is None:
        for seed in seeds if known.goal_conditioned else ():
            advice = "choose another --seed, or give goals by --goals"
            refuse_test_goal(seed, what=f"the episode of seed {seed}", advice=advice)
        return
    for goal in load_goals(check_goals(config.goals, task)):
        advice = f"give goals of other seeds {making}"
        refuse_test_goal(goal.seed, what=config.goals, advice=advice)


def _check_teacher(config: CorrectConfig, task: str, seed: int) -> None:
    """Ask the teacher once, so that one that is not for the task leaves nothing behind.

    Raises:
        InputError: it has nothing to say.
    """
    teach = demonstrator(config.teacher)
    said: list[Action | None] = []

    def act(worlds: Worlds, runs: Mapping[int, EpisodeRun[None]]) -> dict[int, Action | None]:
        said.extend(_learnable(each, worlds.task) for each in teach(worlds, runs).values())
        return dict.fromkeys(runs)

    worlds, goals = worlds_for(task, config.robot), goals_in_turn(config.goals)
    for _ in play(worlds, [seed], act=act, look=lambda *_: None, goals=goals):
        pass
    if not any(each is not None for each in said):
        raise InputError(
            f"{config.teacher} has nothing to say of {task} in the episode of seed {seed}; choose "
            "another --teacher"
        )


def _copy(source: Path, out: Path, seeds: Sequence[int]) -> None:
    """Have files of these seeds in the folder, each whole or not at all."""
    for name in map(episode_name, seeds):
        if (out / name).exists():
            continue
        with whole_file(out / name) as temporary:
            shutil.copyfile(source / name, temporary)


@dataclass(frozen=True)
class _Chunk:
    config: CorrectConfig
    snapshot: Path
    weights: str
    seeds: tuple[int, ...]


def _correct_chunk(chunk: _Chunk) -> Iterator[Attempt]:
    """Play and label episodes; each is a file and a line of the ledger at once."""
    config, policy = chunk.config, load_policy(chunk.snapshot)
    worlds = worlds_for(policy.description.task, config.robot)
    writer = EpisodeWriter(config.out, overwrite=True)  # by the same episode, if at all
    # as in evaluation; nothing of a protocol but its manner of playing is used
    chosen = acting(policy, Protocol(split="test", episodes=1, robot=config.robot))
    teach = demonstrator(config.teacher)
    labels: dict[int, list[Action | None]] = {}

    def act(worlds: Worlds, runs: Mapping[int, EpisodeRun[Step]]) -> Mapping[int, Action | None]:
        """What the policy does; what the teacher would do is taken down."""
        for slot, said in teach(worlds, runs).items():
            if not runs[slot].actions:
                labels[slot] = []
            labels[slot].append(_learnable(said, worlds.task))
        return chosen(worlds, runs)

    goals = goals_in_turn(config.goals)
    for slot, run in play(worlds, chunk.seeds, act=act, look=observe, goals=goals):
        said = labels.pop(slot, [])
        reason = _reason(run, said)
        score = run.rows[-1].score if run.rows else 0.0
        if reason == "":
            episode = record(worlds, slot, run, demonstrator=corrector(config.teacher))
            writer.write(_labelled(episode, correction(config.teacher, said, policy=chunk.weights)))
        attempt = Attempt(
            run.seed, reason == "", len(run.actions), score, reason or run.ended or ""
        )
        append_attempt(config.out, attempt)
        yield attempt


def _learnable(action: Action | None, task: Task) -> Action | None:
    """A teacher's action if agents can learn it: in view, with the lift of a stage."""
    if action is None:
        return None
    pixels = task.grid.to_pixel(np.stack([action[:2], action[3:5]]))
    seen = ((pixels >= 0) & (pixels < SHAPE)).all()
    lifts = np.abs(np.array(task_lifts(task)) - action[6]).min() <= _LIFT_GAP
    return np.array(action, dtype=np.float64) if seen and lifts else None


def _reason(run: EpisodeRun[Step], labels: Sequence[Action | None]) -> str:
    """Why an episode is not kept; empty if it is."""
    if not run.rows or len(run.rows) != len(run.actions) + 1:
        return run.ended or "physics"
    if not any(label is not None for label in labels):
        return "no label"
    return ""


def _labelled(episode: Episode, extra: Mapping[str, Any]) -> Episode:
    info = episode.info
    return replace(episode, info=replace(info, extra={**info.extra, **extra}))


def _report(config: CorrectConfig, out: Path, seeds: set[int], seconds: float) -> CorrectReport:
    infos = EpisodeReader(out).infos()
    new = [info for info in infos if info.seed in seeds]
    before = [info for info in infos if info.seed not in seeds]
    shown = [info.actions for info in before if not is_corrected(info.demonstrator)]
    labels = sum(map(_labels, new))
    return CorrectReport(
        task=infos[0].task,
        teacher=config.teacher,
        out=str(config.out),
        episodes=len(seeds),
        corrected=len(new),
        solved=sum(info.success for info in new),
        mean_score=math.fsum(info.score for info in new) / max(len(new), 1),
        labels=labels,
        before=len(before),
        before_labels=sum(map(_labels, before)),
        equal_demonstrations=labels * len(shown) / sum(shown) if sum(shown) else None,
        state_hash=combine_hashes(info.state_hash for info in infos),
        seconds=seconds,
    )


def _labels(info: EpisodeInfo) -> int:
    """What there is to learn in an episode."""
    if not is_corrected(info.demonstrator):
        return info.actions
    return sum(label is not None for label in labels_of(info, what=episode_name(info.seed)))
