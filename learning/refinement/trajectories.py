"""Better trajectories from recorded ones: shorter, more exact, smoother, and in no respect worse.

An episode at 20 Hz starts again from its seed. A search walks its path faster, with rounded corners
and displaced places, see `TrajectoryProblem`. What it finds is played as the environment plays
actions, and takes the place of the original only if that ends solved and `Walk.beats` it.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from warp_deform.collecting.control_demos import replay_acts
from warp_deform.collecting.control_episodes import (
    ControlEpisode,
    ControlSetup,
    control_worlds,
    play_control_episodes,
    record_control,
    without_idle_end,
)
from warp_deform.collecting.control_replay import setup_of
from warp_deform.collecting.folder import Attempt, Collection, append_attempt
from warp_deform.collecting.goals import CONSTRUCTED
from warp_deform.collecting.workers import Workers, worker_count
from warp_deform.control.control_worlds import ControlWorlds
from warp_deform.control.plan_search import optimize
from warp_deform.control.trajectory_measures import Walk
from warp_deform.control.trajectory_problem import TrajectoryProblem
from warp_deform.episodes import (
    Episode,
    EpisodeInfo,
    EpisodeReader,
    EpisodeWriter,
    combine_hashes,
    rebuild_index,
)
from warp_deform.episodes.goals import goal_is_own
from warp_deform.errors import InputError
from warp_deform.support.progress import progress_bar
from warp_deform.worlds.loop import SOLVED

from .refine import REFINED, REFINEMENT, seeds_by_task
from .resampling import resampled, setup_for
from .settings import TrajectorySettings

__all__ = ["TrajectoryConfig", "TrajectoryReport", "refine_trajectories"]

RESAMPLED = "resampled"
"""Demonstrator of episodes that were picks and places, and that no search has made better."""
_COLLECTED = 64
_POPULATION = 24
"""Plans of a round: three groups of lanes."""
_CHUNK = 8


@dataclass(frozen=True, kw_only=True)
class TrajectoryConfig(TrajectorySettings):
    """The settings of a refinement of trajectories, checked.

    Raises:
        InputError: a number is out of its range.
    """

    def __post_init__(self) -> None:
        for name in ("evaluations", "horizon"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise InputError(f"{name} is {value}; it must be 1 or more")


@dataclass(frozen=True)
class TrajectoryReport:
    """What came of it, of all episodes that the new folder holds.

    Attributes:
        improved: episodes that took the place of the original
        lost: picks and places that at 20 Hz do not solve their task; they are left out
        score_before: mean, where the loss counts
        score_after: the same afterwards
        actions_before: control steps together
        actions_after: the same afterwards
        loss_before: mean of `Measures.loss`
        loss_after: the same afterwards
        roughness_before: mean of `Measures.roughness`
        roughness_after: the same afterwards
        unrested_before: episodes that are not solved once everything is let go
        unrested_after: the same afterwards
        kept: why originals were kept, and how many
        seconds: what this run took [s]
        state_hash: of the new folder's episodes in the order of their seeds
    """

    episodes: int
    improved: int
    lost: int
    score_before: float
    score_after: float
    actions_before: int
    actions_after: int
    loss_before: float
    loss_after: float
    roughness_before: float
    roughness_after: float
    unrested_before: int
    unrested_after: int
    kept: dict[str, int]
    seconds: float
    state_hash: str


def refine_trajectories(config: TrajectoryConfig) -> TrajectoryReport:
    """Refine a folder into another; goes on where an earlier run of the same was interrupted.

    An episode depends on the recording and the search alone, so neither the number of workers nor
    an interruption changes a bit. Picks and places are led at 20 Hz first.

    Raises:
        InputError: there is nothing to refine, an episode cannot be simulated again here, or the
            new folder is the old one or holds something else.
    """
    began = time.perf_counter()
    source, out = Path(config.source).resolve(), Path(config.out).resolve()
    if source == out:
        raise InputError(f"{config.out} is the folder to refine; give --out another folder")
    config = replace(config, source=source, out=out)
    reader = EpisodeReader(source, control=True)
    infos = reader.infos()
    groups = _groups(source, infos, config)
    count = worker_count(config.workers, _COLLECTED * len(reader))
    with Collection(out, _description(config, infos)).owned() as collection:
        done = collection.attempts
        todo = {how: [s for s in of if s not in done] for how, of in groups.items()}
        left = sum(map(len, todo.values()))
        size = max(1, min(_CHUNK, math.ceil(left / count)))
        chunks = [
            _Chunk(config, how, tuple(seeds[i : i + size]))
            for how, seeds in todo.items()
            for i in range(0, len(seeds), size)
        ]
        bar = progress_bar("refine", len(reader), done=len(reader) - left)
        with Workers(min(count, max(1, len(chunks)))) as crew, bar as advance:
            for attempt in crew.run(_refine_chunk, chunks):
                done[attempt.seed] = attempt
                advance()
    if not any(attempt.success for attempt in done.values()):
        reasons = sorted({attempt.reason for attempt in done.values()})
        raise InputError(f"no episode of {source} could be led at 20 Hz: {'; '.join(reasons)}")
    rebuild_index(out)
    found = EpisodeReader(out, control=True).infos()
    return _report(found, len(done) - len(found), time.perf_counter() - began)


def _groups(
    source: Path, infos: Sequence[EpisodeInfo], config: TrajectoryConfig
) -> dict[ControlSetup, list[int]]:
    """Seeds by how their tips are led."""
    groups: dict[ControlSetup, list[int]] = {}
    for info in infos:
        if info.control is None:
            seeds_by_task(source, [info])  # refuses what is no demonstration
            goal = info.goal
            if goal is not None and not (goal["kind"] == CONSTRUCTED and goal_is_own(info)):
                raise InputError(
                    f"{source} has goals that are not those of its seeds, which control cannot "
                    "repeat; collect with `warp-deform demo --control` instead"
                )
            how = setup_for(info, horizon=config.horizon)
        else:
            if config.horizon is not None:
                raise InputError("--horizon is for picks and places; control has its own")
            how = setup_of(info)
        groups.setdefault(how, []).append(info.seed)
    return groups


@dataclass(frozen=True)
class _Chunk:
    config: TrajectoryConfig
    how: ControlSetup
    seeds: tuple[int, ...]


def _refine_chunk(chunk: _Chunk) -> Iterator[Attempt]:
    """Refine episodes one after the other; each is a file and a line of the ledger at once."""
    config, control = chunk.config, control_worlds(chunk.how)
    reader = EpisodeReader(config.source, control=True)
    writer = EpisodeWriter(config.out, overwrite=True)  # by the same episode, if at all
    for seed in chunk.seeds:
        original = reader.read(seed)
        reason = SOLVED
        actions: np.ndarray | None = _actions(original)
        if original.info.control is None:
            actions, reason = resampled(original, chunk.how)
        if actions is None:
            attempt = Attempt(seed, False, 0, 0.0, reason)
        else:
            episode = _refined(control, original, actions, config)
            writer.write(episode)
            story = episode.info.extra[REFINEMENT]
            attempt = Attempt(seed, True, episode.info.actions, episode.info.score, story["why"])
        append_attempt(config.out, attempt)
        yield attempt


def _actions(episode: Episode) -> np.ndarray:
    return np.array([step.action for step in episode.steps if step.action is not None])


def _refined(
    control: ControlWorlds, original: Episode, actions: np.ndarray, config: TrajectoryConfig
) -> Episode:
    """The better one of a recorded episode and of what a search makes of it."""
    before = original.info
    seed, pictures = before.seed, before.control is not None and before.control.pictures
    slot, run = _played(control, seed, actions, pictures=pictures, to_the_end=True)
    kept = original
    if before.control is None:
        kept = record_control(control, slot, run, demonstrator=RESAMPLED, pictures=False)
        kept = replace(kept, info=replace(kept.info, success=True))
    elif run.rows[-1].state_hash != original.steps[-1].state_hash:
        raise InputError(
            f"the episode of seed {seed} does not come out as recorded; refine it with the version "
            "and on the kind of processor that recorded it, see `warp-deform replay`"
        )
    problem = TrajectoryProblem(control, seed, actions)
    found = optimize(
        problem,
        config.method,
        evaluations=config.evaluations,
        population=_POPULATION,
        seed=seed,
    )
    tried, why = _judged(control, problem, found.numbers[0], pictures=pictures)
    recorded, after = problem.recorded, problem.recorded
    if tried is not None:
        kept, after = tried
    story = {
        "improved": tried is not None,
        "why": why,
        "demonstrator": before.demonstrator,
        "state_hash_before": before.state_hash,
        "before": _told(recorded),
        "after": _told(after),
        "method": config.method,
        "evaluations": config.evaluations,
    }
    return replace(kept, info=replace(kept.info, extra={**kept.info.extra, REFINEMENT: story}))


def _played(
    control: ControlWorlds, seed: int, actions: np.ndarray, *, pictures: bool, to_the_end: bool
) -> tuple[int, ControlEpisode]:
    """An episode as the environment plays actions, and its slot, where it has just ended."""
    act = replay_acts({seed: list(actions)})
    runs = play_control_episodes(
        control, [seed], start=lambda runs: None, act=act, pictures=pictures, to_the_end=to_the_end
    )
    ((slot, run),) = runs
    return slot, run


def _judged(
    control: ControlWorlds, problem: TrajectoryProblem, numbers: np.ndarray, *, pictures: bool
) -> tuple[tuple[Episode, Walk] | None, str]:
    """The episode that a plan gives, where it is better than the recording, or why it is not."""
    walk = problem.walks(numbers[None])[0]
    if walk.measures is None:
        return None, "a guard fires"
    slot, run = _played(
        control, problem.seed, walk.actions.astype(float), pictures=pictures, to_the_end=False
    )
    if run.ended != SOLVED:
        return None, "not solved"
    run = without_idle_end(run)
    episode = record_control(control, slot, run, demonstrator=REFINED, pictures=pictures)
    # the environment may have ended it early, so what counts is what was recorded
    walk = problem.follow(np.array(run.actions, np.float32))
    if not walk.rests and problem.recorded.rests:
        return None, "not solved at rest"
    if not walk.beats(problem.recorded):
        return None, "not better"
    return (episode, walk), REFINED


def _told(walk: Walk) -> dict[str, Any]:
    assert walk.measures is not None, "no guard has fired"
    return {**asdict(walk.measures), "solved": bool(walk.rests), "score": walk.score}


def _description(config: TrajectoryConfig, infos: Sequence[EpisodeInfo]) -> dict[str, Any]:
    """What all episodes of the new folder have in common."""
    return {
        "trajectories_of": combine_hashes(info.state_hash for info in infos),
        "seeds": combine_hashes(f"{info.seed:x}" for info in infos),
        "method": config.method,
        "evaluations": config.evaluations,
        "horizon": config.horizon,
    }


def _report(infos: Sequence[EpisodeInfo], lost: int, seconds: float) -> TrajectoryReport:
    stories = [info.extra[REFINEMENT] for info in infos]
    before, after = ([story[name] for story in stories] for name in ("before", "after"))

    def mean(told: Sequence[Mapping[str, Any]], name: str) -> float:
        return math.fsum(each[name] for each in told) / len(told)

    return TrajectoryReport(
        episodes=len(infos),
        improved=sum(story["improved"] for story in stories),
        lost=lost,
        score_before=mean(before, "score"),
        score_after=mean(after, "score"),
        actions_before=sum(each["steps"] for each in before),
        actions_after=sum(each["steps"] for each in after),
        loss_before=mean(before, "loss"),
        loss_after=mean(after, "loss"),
        roughness_before=mean(before, "roughness"),
        roughness_after=mean(after, "roughness"),
        unrested_before=sum(not each["solved"] for each in before),
        unrested_after=sum(not each["solved"] for each in after),
        kept=dict(sorted(Counter(s["why"] for s in stories if not s["improved"]).items())),
        seconds=seconds,
        state_hash=combine_hashes(info.state_hash for info in infos),
    )
