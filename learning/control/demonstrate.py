"""A policy of control demonstrates: the episodes that it solves become a dataset at 20 Hz.

A search finds a swing for one goal after the other, and for two goals side by side it may find two
that have nothing in common. A policy is one function of all goals, so what it shows can be cloned.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from warp_deform.collecting.control_episodes import (
    ControlEpisode,
    ControlSetup,
    control_worlds,
    observed,
    play_control_episodes,
    record_control,
    without_idle_end,
)
from warp_deform.collecting.folder import Attempt, Collection, append_attempt
from warp_deform.control.control_worlds import ControlWorlds
from warp_deform.control.registry import control_task
from warp_deform.episodes import EpisodeReader, EpisodeWriter, combine_hashes, rebuild_index
from warp_deform.errors import InputError
from warp_deform.support.progress import progress_bar
from warp_deform.worlds.loop import SOLVED

from ..evaluation.protocol import FIRST_SEED
from ..runs.folder import read_record
from .actor import Actor, PlanActor
from .run import ControlRun
from .saved import load_actor

__all__ = ["POLICY", "Acting", "Demonstrations", "demonstrate"]

POLICY = "policy"
"""Demonstrator of the episodes."""


@dataclass(frozen=True, kw_only=True)
class Demonstrations:
    """What a policy has demonstrated.

    Attributes:
        task: its name
        run: folder of the policy's run
        selected: the snapshot that played, the best on validation seeds
        out: folder of the dataset
        episodes: seeds that were played, all in all
        solved: episodes that the dataset holds
        mean_score: at the end, of all that were played
        state_hash: of the kept episodes' hashes in the order of their seeds
        seconds: of this call
    """

    task: str
    run: str
    selected: int
    out: str
    episodes: int
    solved: int
    mean_score: float
    state_hash: str
    seconds: float


class Acting:
    """A policy acts in worlds: every slot has a copy, for a plan is kept from its first step on."""

    def __init__(self, actor: Actor | PlanActor, control: ControlWorlds) -> None:
        self._control = control
        self._actors = {slot: copy.deepcopy(actor) for slot in range(control.worlds.count)}

    def __call__(self, runs: Mapping[int, ControlEpisode]) -> dict[int, np.ndarray | None]:
        """Actions (A,) by slot."""
        with torch.no_grad():
            return {slot: self._acted(slot, run) for slot, run in runs.items()}

    def _acted(self, slot: int, run: ControlEpisode) -> np.ndarray:
        seen = torch.from_numpy(observed(self._control, slot, run))
        action: np.ndarray = self._actors[slot](seen[None])[0].numpy()
        return action


def demonstrate(folder: Path, out: Path, *, episodes: int, progress: bool = True) -> Demonstrations:
    """Record what a run's chosen snapshot solves of the seeds 0, 1, ...

    An episode depends on the weights and its seed alone. The same call goes on where an earlier one
    was interrupted.

    Args:
        folder: of `warp-deform train-control`
        out: the dataset
        episodes: seeds that are played

    Raises:
        InputError: `folder` is no control run's, has no snapshot yet, `episodes` is below 1 or
            would reach the seeds of tests, `out` holds something else, or nothing is solved.
    """
    clock = time.perf_counter()
    if not 1 <= episodes <= FIRST_SEED["test"]:
        raise InputError(f"episodes is {episodes}; it must be 1 to {FIRST_SEED['test']}")
    run = ControlRun(folder)
    settings, chosen = run.read_control()["control"], run.chosen()
    actor, task = load_actor(run.snapshot(chosen))
    how = ControlSetup(type(control_task(task)), start="held", horizon=settings["horizon"])
    control = control_worlds(how)
    weights = read_record(run.snapshot(chosen)).get("digest")
    description = {"policy": weights, "task": task, "horizon": settings["horizon"]}
    with Collection(Path(out), description).owned() as collection:
        writer, done = EpisodeWriter(collection.folder, overwrite=True), collection.attempts
        seeds = [seed for seed in range(episodes) if seed not in done]
        done_before = episodes - len(seeds)
        bar = progress_bar(f"demonstrate {task}", episodes, done=done_before, shown=progress)
        with bar as advance:
            played = play_control_episodes(
                control, seeds, start=lambda runs: None, act=Acting(actor, control)
            )
            for slot, one in played:
                success = one.ended == SOLVED
                if success:
                    kept = without_idle_end(one)
                    writer.write(
                        record_control(control, slot, kept, demonstrator=POLICY, pictures=False)
                    )
                score = one.rows[-1].score if one.rows else 0.0
                attempt = Attempt(one.seed, success, len(one.actions), score, one.ended or "")
                append_attempt(collection.folder, attempt)
                done[one.seed] = attempt
                advance()
        attempts = [done[seed] for seed in range(episodes)]
        if not any(attempt.success for attempt in attempts):
            raise InputError(f"{folder} solves none of {episodes} episodes; train it for longer")
    rebuild_index(Path(out))
    infos = EpisodeReader(out, control=True).infos()
    return Demonstrations(
        task=task,
        run=str(folder),
        selected=chosen,
        out=str(out),
        episodes=episodes,
        solved=sum(attempt.success for attempt in attempts),
        mean_score=sum(attempt.score for attempt in attempts) / episodes,
        state_hash=combine_hashes(info.state_hash for info in infos),
        seconds=time.perf_counter() - clock,
    )
