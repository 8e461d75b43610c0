"""Paths between pick and place that are better than straight ones, for recorded actions.

Every action of a folder of demonstrations is run again from the state in which it was recorded,
along its straight path and along paths whose waypoints descend the gradient of the task's loss. The
best one is written, with what both lead to. That is no demonstration: an action's seven numbers,
which are all that a policy has, cannot say such a path. So the folder holds no episodes.

waypoints.json             the label: what the paths are of, and how they were found
waypoints_000000300.json   the actions of the episode of seed 300
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from warp_deform.collecting.replay import Recording
from warp_deform.collecting.workers import Workers, worker_count
from warp_deform.episodes import EpisodeReader, combine_hashes
from warp_deform.errors import InputError
from warp_deform.planning.waypoints import BentPath, WaypointConfig, Waypoints
from warp_deform.rollout.rollouts import GripPath
from warp_deform.support.progress import progress_bar
from warp_deform.support.whole_file import whole_file
from warp_deform.tasks.registry import task as find_task
from warp_deform.tasks.task import Action
from warp_deform.worlds.loop import EpisodeRun, play, worlds_for
from warp_deform.worlds.state import WorldState
from warp_deform.worlds.worlds import Worlds

from .refine import seeds_by_task
from .settings import FolderSettings

__all__ = ["WAYPOINTS", "BendConfig", "BendReport", "bend", "read_path"]

WAYPOINTS = "waypoints"
"""What the label calls the folder's contents, where other folders name a demonstrator."""
_LABEL = "waypoints.json"
_FORMAT = 1
_CHUNK = 8
_COLLECTED = 32
"""Bending the paths of an episode takes as long as collecting so many."""


@dataclass(frozen=True, kw_only=True)
class BendConfig(FolderSettings):
    """The paths of which folder are bent, and how; `out` is then a folder for paths."""

    bending: WaypointConfig = field(default_factory=WaypointConfig)
    """How waypoints are moved."""


@dataclass(frozen=True)
class BendReport:
    """What came of it.

    Attributes:
        actions: those whose straight path ran
        bent: for how many a better one was found
        loss_before: mean over `actions` of the task's loss after the straight path; None where
            there are none
        loss_after: the same after the best path
        score_before: mean over `actions` of the score after the straight path; None where there
            are none
        score_after: the same after the best path
        seconds: what this run took [s]
    """

    demonstrator: str
    episodes: int
    actions: int
    bent: int
    loss_before: float | None
    loss_after: float | None
    score_before: float | None
    score_after: float | None
    seconds: float


def bend(config: BendConfig) -> BendReport:
    """Bend the paths of a folder's actions; goes on where an earlier run of the same was stopped.

    An episode's paths depend on the recording and the settings alone.

    Raises:
        InputError: there is nothing to bend, a task has no loss, an episode cannot be simulated
            again here, or the new folder holds something else.
    """
    began = time.perf_counter()
    source, out = Path(config.source).resolve(), Path(config.out).resolve()
    if source == out:
        raise InputError(f"{config.out} holds the demonstrations; give --out another folder")
    config = replace(config, source=source, out=out)
    infos = EpisodeReader(source).infos()
    groups = seeds_by_task(source, infos)
    for task, _ in groups:
        if not find_task(task).has_loss():
            raise InputError(f"{task} has no loss to differentiate, so no paths to bend by")
    _label(config, combine_hashes(info.state_hash for info in infos))
    todo = {k: [s for s in of if not _file(out, s).exists()] for k, of in groups.items()}
    chunks = [
        _Chunk(config, *kind, tuple(seeds[i : i + _CHUNK]))
        for kind, seeds in todo.items()
        for i in range(0, len(seeds), _CHUNK)
    ]
    count = worker_count(config.workers, _COLLECTED * len(infos))
    left = sum(map(len, todo.values()))
    bar = progress_bar("refine, waypoints", len(infos), done=len(infos) - left)
    with Workers(min(count, max(1, len(chunks)))) as crew, bar as advance:
        for _ in crew.run(_bend_chunk, chunks):
            advance()
    stories = [json.loads(_file(out, info.seed).read_text()) for info in infos]
    ran = [a for story in stories for a in story["actions"] if a["before"] is not None]

    def mean(when: str, what: str) -> float | None:
        return math.fsum(a[when][what] for a in ran) / len(ran) if ran else None

    return BendReport(
        demonstrator=WAYPOINTS,
        episodes=len(infos),
        actions=len(ran),
        bent=sum(a["path"] is not None for a in ran),
        loss_before=mean("before", "loss"),
        loss_after=mean("after", "loss"),
        score_before=mean("before", "score"),
        score_after=mean("after", "score"),
        seconds=time.perf_counter() - began,
    )


def read_path(written: Mapping[str, Any]) -> GripPath:
    """A path as it was written, bit for bit, for `Waypoints.run`.

    Raises:
        InputError: it is not one.
    """
    try:
        return GripPath(
            times=np.array(written["times"], dtype=float),
            positions=np.array(written["positions"], dtype=float),
            rotations=np.array(written["rotations"], dtype=float),
            offset=np.array(written["offset"], dtype=float),
            turn=np.array(written["turn"], dtype=float),
            particle=written["particle"],
            body=written["body"],
            lower=None if written["lower"] is None else tuple(written["lower"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"this is no path of waypoints: {error}") from error


@dataclass(frozen=True)
class _Chunk:
    config: BendConfig
    task: str
    robot: str
    seeds: tuple[int, ...]


def _bend_chunk(chunk: _Chunk) -> Iterator[int]:
    config, worlds = chunk.config, worlds_for(chunk.task, chunk.robot)
    recording = Recording(EpisodeReader(config.source))
    bending = Waypoints(worlds.task, robot=chunk.robot, precision=worlds.precision)
    for seed in chunk.seeds:
        jobs = _recorded(worlds, recording, seed)
        steps = recording.episodes.pop(seed).steps
        bent = bending.bend(jobs, config.bending)
        story = {
            "format": _FORMAT,
            "demonstrator": WAYPOINTS,
            "task": chunk.task,
            "robot": chunk.robot,
            "seed": seed,
            "actions": [
                _written(one, action, step.state_hash)
                for one, (_, action), step in zip(bent, jobs, steps, strict=False)
            ],
        }
        _write(_file(config.out, seed), story)
        yield seed


def _recorded(worlds: Worlds, recording: Recording, seed: int) -> list[tuple[WorldState, Action]]:
    """The recorded actions of an episode, and the states they were recorded in."""
    jobs: list[tuple[WorldState, Action]] = []

    def act(worlds: Worlds, runs: Mapping[int, EpisodeRun[str]]) -> dict[int, Action | None]:
        actions = recording.act(worlds, runs)
        for slot, action in actions.items():
            if action is not None:
                jobs.append((worlds.state(slot), action))
        return actions

    goal = recording.goal(seed)
    look = Worlds.hash
    runs = play(worlds, [seed], act=act, look=look, goals=lambda _: goal, until_solved=False)
    ((_, run),) = runs
    if run.rows != [step.state_hash for step in recording.episodes[seed].steps]:
        raise InputError(
            f"the episode of seed {seed} does not go as recorded; use the version and the kind of "
            "processor that recorded it, see `warp-deform replay`"
        )
    return jobs


def _written(bent: BentPath, action: Action, state_hash: str) -> dict[str, Any]:
    """What is written about an action.

    Args:
        state_hash: of the state before it
    """
    path = None
    if bent.path is not None:
        path = {
            name: value.tolist() if isinstance(value, np.ndarray) else value
            for name, value in vars(bent.path).items()
        }
    return {
        "action": action.tolist(),
        "state_hash": state_hash,
        "before": None if bent.before is None else asdict(bent.before),
        "after": None if bent.after is None else asdict(bent.after),
        "steps": bent.steps,
        "growth": bent.growth,
        "path": path,
    }


def _label(config: BendConfig, recorded: str) -> None:
    """Label the folder, or make sure that it has this label."""
    label = {
        "format": _FORMAT,
        "demonstrator": WAYPOINTS,
        "recorded": recorded,
        "bending": asdict(config.bending),
    }
    path = config.out / _LABEL
    if path.exists():
        if json.loads(path.read_text()) != label:
            raise InputError(
                f"{config.out} holds paths of other demonstrations or settings; choose another "
                "folder"
            )
        return
    if config.out.exists() and (not config.out.is_dir() or any(config.out.iterdir())):
        raise InputError(f"{config.out} holds something else; choose another folder for the paths")
    config.out.mkdir(parents=True, exist_ok=True)
    _write(path, label)


def _file(folder: Path, seed: int) -> Path:
    return folder / f"waypoints_{seed:09d}.json"


def _write(path: Path, values: Mapping[str, Any]) -> None:
    """Write a whole file or none."""
    with whole_file(path) as temporary:
        temporary.write_text(json.dumps(values, allow_nan=False))
