"""Better demonstrations from recorded ones, by search in the simulator.

An episode starts again from its seed. Before every action a search tries others, the recorded one
among them as long as the episode is where the recording was, and the best is carried out exactly as
a policy's action is. So a refined episode is an episode like any other: it replays from its seed.
It takes the place of the original only if it is better by the task's own score, not by what the
search went by: see `ACCEPT`.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from warp_deform.collecting.folder import Attempt, Collection, append_attempt
from warp_deform.collecting.goals import CONSTRUCTED
from warp_deform.collecting.recording import observe, record
from warp_deform.collecting.replay import Recording
from warp_deform.collecting.workers import Workers, worker_count
from warp_deform.episodes import (
    Episode,
    EpisodeInfo,
    EpisodeReader,
    EpisodeWriter,
    Step,
    combine_hashes,
    rebuild_index,
)
from warp_deform.episodes.corrected import refuse_corrected
from warp_deform.episodes.enclosed import ENCLOSED
from warp_deform.errors import InputError
from warp_deform.planning import SearchConfig, lookahead_for, search
from warp_deform.robots import robot as find_robot
from warp_deform.support.progress import progress_bar
from warp_deform.tasks.registry import task as find_task
from warp_deform.tasks.task import Action
from warp_deform.worlds.loop import SOLVED, EpisodeRun, play, worlds_for
from warp_deform.worlds.worlds import Worlds

from .settings import RefineSettings

__all__ = [
    "ACCEPT",
    "RECORDED",
    "REFINED",
    "REFINEMENT",
    "RefineConfig",
    "RefineReport",
    "refine",
    "seeds_by_task",
]

ACCEPT = ("score", "solved")
"""When a new episode takes the place of the original. `score`: no lower last score, no more
actions, and one of them better. `solved`: where both solve the task, fewer actions, or as many and
a higher last score; where the original does not solve it, as `score`."""

REFINEMENT = "refinement"
"""Where `EpisodeInfo.extra` says what became of an episode."""
REFINED = "refined"
"""Demonstrator of the episodes that are better than the original."""
RECORDED = "recorded"
"""Origin of an action that is the recorded one; for others see `planning.Outlook.origin`."""
_TRIED_AT_ONCE = 64
_COLLECTED = 64
"""Refining takes as long as collecting so many episodes: two are worth a second process."""
_CHUNK = 16


@dataclass(frozen=True, kw_only=True)
class RefineConfig(RefineSettings):
    """The settings of a refinement, checked, and how each action is searched."""

    search: SearchConfig = field(default_factory=SearchConfig)
    """Its budget is per action. What an action that solves the task leaves of it goes into better
    ones, whatever `SearchConfig.polish` says."""

    def __post_init__(self) -> None:
        if self.accept not in ACCEPT:
            raise InputError(f"no rule {self.accept!r}; choose from {', '.join(ACCEPT)}")


@dataclass(frozen=True)
class RefineReport:
    """What came of it.

    Attributes:
        improved: episodes that took the place of the original
        score_before: mean over all episodes before
        score_after: mean over all episodes afterwards
        actions_before: sum over all episodes before
        actions_after: sum over all episodes afterwards
        origins: how many actions of the episodes that took the place of the original come from
            where, see `planning.Outlook.origin`
        seconds: what this run took [s]
        state_hash: of the new folder's episodes in the order of their seeds
    """

    episodes: int
    improved: int
    score_before: float
    score_after: float
    actions_before: int
    actions_after: int
    origins: dict[str, int]
    seconds: float
    state_hash: str


def refine(config: RefineConfig) -> RefineReport:
    """Refine a folder into another; goes on where an earlier run of the same was interrupted.

    An episode depends on the recording and the search alone, so neither the number of workers nor
    an interruption changes a bit.

    Raises:
        InputError: there is nothing to refine, an episode cannot be simulated again here, the
            task has no loss to differentiate, or the new folder is the old one or holds something
            else.
    """
    began = time.perf_counter()
    source, out = Path(config.source).resolve(), Path(config.out).resolve()
    if source == out:
        raise InputError(f"{config.out} is the folder to refine; give --out another folder")
    search = replace(config.search, polish=True)
    config = replace(config, source=source, out=out, search=search)
    reader = EpisodeReader(source)
    infos = reader.infos()
    groups = seeds_by_task(source, infos)
    for task, robot in groups:
        _check_search(task, robot, config.search)
    count = worker_count(config.workers, _COLLECTED * len(reader))
    with Collection(out, _description(config, infos)).owned() as collection:
        todo = {
            kind: [s for s in of if s not in collection.attempts] for kind, of in groups.items()
        }
        left = sum(map(len, todo.values()))
        size = max(1, min(_CHUNK, math.ceil(left / count)))
        chunks = [
            _Chunk(config, *kind, tuple(seeds[i : i + size]))
            for kind, seeds in todo.items()
            for i in range(0, len(seeds), size)
        ]
        bar = progress_bar("refine", len(reader), done=len(reader) - left)
        with Workers(min(count, max(1, len(chunks)))) as crew, bar as advance:
            for _ in crew.run(_refine_chunk, chunks):
                advance()
    rebuild_index(out)
    return _report(EpisodeReader(out).infos(), time.perf_counter() - began)


def seeds_by_task(source: Path, infos: Sequence[EpisodeInfo]) -> dict[tuple[str, str], list[int]]:
    """Seeds of a folder's demonstrations by task and robot.

    Raises:
        InputError: they are no demonstrations.
    """
    refuse_corrected(infos, folder=source, advice="refine demonstrations before correcting")
    groups: dict[tuple[str, str], list[int]] = {}
    for info in infos:
        if info.demonstrator == CONSTRUCTED:
            raise InputError(f"{source} holds goals that nobody acted for; give demonstrations")
        groups.setdefault((info.task, info.robot), []).append(info.seed)
    return groups


def _check_search(task: str, robot: str, config: SearchConfig) -> None:
    """Raise InputError unless task and robot are known and have what the search goes by."""
    find_robot(robot)
    if config.method == "gradient" and not find_task(task).has_loss():
        raise InputError(f"{task} has no loss to differentiate; choose another method")


@dataclass(frozen=True)
class _Chunk:
    config: RefineConfig
    task: str
    robot: str
    seeds: tuple[int, ...]


def _refine_chunk(chunk: _Chunk) -> Iterator[int]:
    """Refine episodes one after the other; each is a file and a line of the ledger at once."""
    config, worlds = chunk.config, worlds_for(chunk.task, chunk.robot)
    recording = Recording(EpisodeReader(config.source))
    writer = EpisodeWriter(config.out, overwrite=True)  # by the same episode, if at all
    for seed in chunk.seeds:
        # Alone, although lanes stay empty: nearly all time goes into the search, whose lanes are
        # full, and an interruption loses one episode a process.
        episode = _refined(worlds, recording, seed, config)
        writer.write(episode)
        info = episode.info
        reason = REFINED if info.extra[REFINEMENT]["improved"] else "kept"
        append_attempt(config.out, Attempt(seed, True, info.actions, info.score, reason))
        yield seed


def _refined(worlds: Worlds, recording: Recording, seed: int, config: RefineConfig) -> Episode:
    """The better one of a recorded episode and of what a search makes of it."""
    goal = recording.goal(seed)
    original = recording.episodes.pop(seed)
    searcher = _Searcher(original, config.search)
    ((slot, run),) = play(worlds, [seed], act=searcher.act, look=observe, goals=lambda _: goal)
    _check_start(original, run)
    before = original.info
    improved = _better(run, before, config.accept, enclosed=worlds.enclosed(slot))
    origins = searcher.origins if improved else [RECORDED] * before.actions
    made = original
    if improved:
        made = record(worlds, slot, run, demonstrator=REFINED)
    story = {
        "improved": improved,
        "demonstrator": before.demonstrator,
        "state_hash_before": before.state_hash,
        "score_before": before.score,
        "score_after": made.info.score,
        "actions_before": before.actions,
        "actions_after": made.info.actions,
        "origins": origins,
        "search": asdict(config.search),
        "accept": config.accept,
        "tried": {
            "score": run.rows[-1].score,
            "actions": len(run.actions),
            "origins": searcher.origins,
            "ended": run.ended,
        },
    }
    return replace(made, info=replace(made.info, extra={**made.info.extra, REFINEMENT: story}))


class _Searcher:
    """A player of `play` that searches every action, and stops where the original did.

    origins: where the actions come from, in order
    """

    def __init__(self, original: Episode, config: SearchConfig) -> None:
        self._original, self._config = original, config
        self.origins: list[str] = []

    def act(self, worlds: Worlds, runs: Mapping[int, EpisodeRun[Step]]) -> dict[int, Action | None]:
        """The best action that a search finds, None when the original had no more."""
        return {slot: self._next(worlds, slot, run) for slot, run in runs.items()}

    def _next(self, worlds: Worlds, slot: int, run: EpisodeRun[Step]) -> Action | None:
        t, steps = len(run.actions), self._original.steps
        if t == 0:
            _check_start(self._original, run)
        if t >= self._original.info.actions:
            return None
        as_recorded = worlds.hash(slot) == steps[t].state_hash
        recorded = steps[t].action if as_recorded else None
        lookahead = lookahead_for(worlds.task, worlds.robot.name, worlds.precision, _TRIED_AT_ONCE)
        outlooks = search(
            lookahead,
            worlds.task,
            worlds.state(slot),
            run.rng,
            self._config,
            also=[] if recorded is None else [recorded],
        )
        if not outlooks:
            return None
        best = outlooks[0]
        if best.solved:  # the search goes by the value of states, but now the score counts
            best = max((o for o in outlooks if o.solved), key=lambda o: (o.grade, o.score))
        same = recorded is not None and best.action.tobytes() == recorded.tobytes()
        self.origins.append(RECORDED if same else best.origin)
        return best.action


def _check_start(original: Episode, run: EpisodeRun[Step]) -> None:
    """Raise InputError unless the episode started as it was recorded."""
    start = original.steps[0]
    if not run.rows or (run.rows[0].state_hash, run.rows[0].score) != (
        start.state_hash,
        start.score,
    ):
        raise InputError(
            f"the episode of seed {run.seed} does not start as recorded; refine it with the "
            "version and on the kind of processor that recorded it, see `warp-deform replay`"
        )


def _better(
    run: EpisodeRun[Step], before: EpisodeInfo, accept: str, *, enclosed: bool | None = None
) -> bool:
    """Whether an episode takes the place of the original.

    Args:
        enclosed: whether its bag keeps its items, see `Task.enclosed`; None where there are none
    """
    if len(run.rows) != len(run.actions) + 1:
        return False  # the physics failed
    score, actions = run.rows[-1].score, len(run.actions)
    if before.success and run.ended != SOLVED:
        return False
    if before.extra.get(ENCLOSED) and enclosed is False:
        return False
    if before.success and accept == "solved":
        return (-actions, score) > (-before.actions, before.score)
    return (
        score >= before.score
        and actions <= before.actions
        and (score > before.score or actions < before.actions)
    )


def _description(config: RefineConfig, infos: Sequence[EpisodeInfo]) -> dict[str, Any]:
    """What all episodes of the new folder have in common."""
    return {
        "refined": combine_hashes(info.state_hash for info in infos),
        "seeds": combine_hashes(f"{info.seed:x}" for info in infos),
        "search": asdict(config.search),
        "accept": config.accept,
    }


def _report(infos: Sequence[EpisodeInfo], seconds: float) -> RefineReport:
    stories = [info.extra[REFINEMENT] for info in infos]
    return RefineReport(
        episodes=len(infos),
        improved=sum(story["improved"] for story in stories),
        score_before=math.fsum(story["score_before"] for story in stories) / len(stories),
        score_after=math.fsum(story["score_after"] for story in stories) / len(stories),
        actions_before=sum(story["actions_before"] for story in stories),
        actions_after=sum(story["actions_after"] for story in stories),
        origins=dict(
            sorted(Counter(o for s in stories if s["improved"] for o in s["origins"]).items())
        ),
        seconds=seconds,
        state_hash=combine_hashes(info.state_hash for info in infos),
    )
