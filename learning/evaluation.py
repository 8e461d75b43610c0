"""Evaluation: which snapshot is best on validation seeds, and how good it is on test seeds.

Seeds of validation (50,000 and up), test (10,000 and up) and goals (100,000 and up) are apart from
those of training. A snapshot is chosen on validation seeds and then plays the test seeds once. The
paper's own protocol, the best of ten snapshots on the test seeds themselves, is a second, labelled
result: it is optimistic.

Source: Seita et al., ICRA 2021, sections on training and evaluation; Wilson, JASA 1927.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.stats import binomtest

from warp_deform.episode_loop import SOLVED, Run, play, worlds_for
from warp_deform.episodes import Goal, versions
from warp_deform.errors import InputError
from warp_deform.goals import GOAL_SEED, load_goals, make_goals
from warp_deform.tasks.registry import task as find_task
from warp_deform.tasks.task import Stage
from warp_deform.workers import Workers
from warp_deform.worlds import Worlds
from warp_deform.wrappers import stage_at

from .policy import (
    AgentDescription,
    ImagePolicy,
    Policy,
    RetryingPolicy,
    StatePolicy,
    load_policy,
)
from .snapshots import RunFolder, read_json, read_snapshot, write_json

__all__ = ["PARTIAL_CREDIT", "Evaluation", "Played", "Protocol", "best", "evaluate_snapshot",
           "known", "summarise"]  # fmt: skip

FIRST_SEED = {"validation": 50_000, "test": 10_000}
PARTIAL_CREDIT = frozenset(
    {
        "cable-shape", "cable-shape-notarget", "cable-line-notarget", "fabric-flat",
        "fabric-flat-notarget", "bag-color-goal",
    }
)  # fmt: skip
"""Tasks whose result in the paper's table is the mean score; that of the others is successes."""


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """What a snapshot plays.

    split: "validation" or "test", whose seeds are played
    episodes: their number, from the split's first seed on
    goals: "constructed": for validation from the episode's own seed, for test from goal seeds;
        "demonstrated": ends of demonstrations on goal seeds, the paper's
    n_goals: goals that the test episodes share in turn
    stage_rule: who chooses the lift, "action" (the policy) or "privileged" (the paper's hidden
        rule, which reads the simulator)
    retry: whether agents over pictures pick elsewhere after an action that changed nothing that
        they see, see `policy.RetryingPolicy`; the paper's do not
    """

    split: Literal["validation", "test"]
    episodes: int
    goals: Literal["constructed", "demonstrated"] = "constructed"
    n_goals: int = 200
    stage_rule: Literal["action", "privileged"] = "action"
    retry: bool = True
    robot: str = "ur5"

    def __post_init__(self) -> None:
        if self.episodes < 1 or self.n_goals < 1:
            raise InputError(f"episodes is {self.episodes}; it must be 1 or more")

    @property
    def seeds(self) -> range:
        """Seeds of the episodes."""
        first = FIRST_SEED[self.split]
        return range(first, first + self.episodes)


@dataclass(frozen=True)
class Played:
    """One episode. score: at its end, 0 if its physics cannot be trusted; reason: why it ended."""

    seed: int
    success: bool
    score: float
    actions: int
    reason: str


@dataclass(frozen=True)
class Evaluation:
    """A snapshot's episodes in the order of their seeds, and what they amount to."""

    step: int
    episodes: tuple[Played, ...]
    summary: dict[str, Any]


def evaluate_snapshot(
    run: RunFolder, step: int, protocol: Protocol, *, workers: int = 1
) -> Evaluation:
    """Play a protocol with a snapshot of a run, or read what was played before.

    An episode depends on snapshot, seed and protocol alone, so neither the number of workers nor an
    interruption changes a result.

    Raises:
        InputError: there is no such snapshot, or it cannot play this.
    """
    description = AgentDescription(**read_snapshot(run.snapshot(step))[1]["agent"])
    path = _path(run, step, protocol)
    done = {} if not path.exists() else {e["seed"]: e for e in read_json(path)["episodes"]}
    missing = [seed for seed in protocol.seeds if seed not in done]
    if missing:
        goals = _goals(run, description.task, protocol)
        crew = Workers(min(workers, len(missing)))
        size = math.ceil(len(missing) / crew.count)
        chunks = [
            _Chunk(
                run.snapshot(step), description.task, protocol, goals, tuple(missing[i : i + size])
            )
            for i in range(0, len(missing), size)
        ]
        run.evaluations.mkdir(exist_ok=True)
        with crew:
            for played in crew.run(_play_chunk, chunks):
                done[played.seed] = asdict(played)
                record = _identity(run, step, protocol)
                write_json(path, {**record, "episodes": [done[seed] for seed in sorted(done)]})
    episodes = tuple(Played(**done[seed]) for seed in protocol.seeds)
    return Evaluation(step, episodes, summarise(episodes, task=description.task))


def known(run: RunFolder, step: int, protocol: Protocol) -> bool:
    """Whether a snapshot has played all of a protocol."""
    path = _path(run, step, protocol)
    if not path.exists():
        return False
    return {e["seed"] for e in read_json(path)["episodes"]} >= set(protocol.seeds)


def best(evaluations: Sequence[Evaluation], *, task: str) -> Evaluation:
    """The evaluation with the best result; of equals that with fewer actions, then the latest."""

    def rank(each: Evaluation) -> tuple[float, float, int]:
        return each.summary[_measure(task)], -each.summary["mean_actions"], each.step

    return max(evaluations, key=rank)


def summarise(episodes: Sequence[Played], *, task: str) -> dict[str, Any]:
    """Numbers that episodes amount to.

    n_episodes, n_success, pc_success [%], pc_success_ci95: Wilson's interval [%], mean_score in
    [0, 1] with its standard_error, mean_actions, mean_actions_solved (of successes, None without),
    paper_value [%]: what the paper's table calls success, see `PARTIAL_CREDIT`
    """
    n, solved = len(episodes), [e for e in episodes if e.success]
    interval = binomtest(len(solved), n).proportion_ci(method="wilson")
    scores = np.array([e.score for e in episodes])
    mean, rate = float(scores.mean()), 100 * len(solved) / n
    return {
        "n_episodes": n,
        "n_success": len(solved),
        "pc_success": rate,
        "pc_success_ci95": [100 * float(interval.low), 100 * float(interval.high)],
        "mean_score": mean,
        "standard_error": float(scores.std(ddof=1) / math.sqrt(n)) if n > 1 else None,
        "mean_actions": float(np.mean([e.actions for e in episodes])),
        "mean_actions_solved": float(np.mean([e.actions for e in solved])) if solved else None,
        "paper_value": 100 * mean if task in PARTIAL_CREDIT else rate,
    }


def _measure(task: str) -> str:
    return "mean_score" if task in PARTIAL_CREDIT else "pc_success"


@dataclass(frozen=True)
class _Chunk:
    """Episodes for one process."""

    snapshot: Path
    task: str
    protocol: Protocol
    goals: Path | None
    seeds: tuple[int, ...]


def _play_chunk(chunk: _Chunk) -> Iterator[Played]:
    """Play episodes side by side; each is yielded when it is over."""
    policy = load_policy(chunk.snapshot)
    worlds = worlds_for(chunk.task, chunk.protocol.robot)
    goals = load_goals(chunk.goals) if chunk.goals is not None else []
    first = FIRST_SEED[chunk.protocol.split]
    stages: dict[int, Stage | None] = {}
    players: dict[int, Policy] = {}

    def goal(seed: int) -> Goal | None:
        return goals[(seed - first) % len(goals)] if goals else None

    def act(worlds: Worlds, runs: Mapping[int, Run[float]]) -> dict[int, np.ndarray | None]:
        """What the policy does in every slot, one picture at a time: no neighbour changes a bit."""
        chosen: dict[int, np.ndarray | None] = {}
        for slot, run in runs.items():
            if not run.actions:
                players[slot] = _player(policy, chunk.protocol)
            seen = _observe(worlds, slot, state=isinstance(policy, StatePolicy))
            action = players[slot].act(seen, rng=run.rng)
            if chunk.protocol.stage_rule == "privileged":
                before = stages.get(slot) if run.actions else None
                stage = stages[slot] = stage_at(worlds, slot, action[:6], before)
                action[6] = stage.lift
            chosen[slot] = action
        return chosen

    def score(worlds: Worlds, slot: int) -> float:
        return float(worlds.score(slot))

    for _, run in play(worlds, chunk.seeds, act=act, look=score, goals=goal):
        ended = run.ended or ""
        # an episode that ends for its physics has one row fewer and counts with nothing
        trusted = bool(run.rows) and len(run.rows) == len(run.actions) + 1
        yield Played(
            run.seed,
            ended == SOLVED,
            run.rows[-1] if trusted else 0.0,
            len(run.actions),
            ended,
        )


def _player(policy: ImagePolicy | StatePolicy, protocol: Protocol) -> Policy:
    """Who plays one episode."""
    if protocol.retry and isinstance(policy, ImagePolicy):
        return RetryingPolicy(policy)
    return policy


def _observe(worlds: Worlds, slot: int, *, state: bool) -> dict[str, np.ndarray]:
    """What a policy sees of a slot."""
    episode = worlds.episodes[slot]
    if state:
        return {"ground_truth": worlds.task.ground_truth(episode.layout, episode.snapshot)}
    images = episode.snapshot.images
    seen = {"color": images.color, "height": images.height}
    if episode.goal is not None:
        seen |= {"goal_color": episode.goal.color, "goal_height": episode.goal.height}
    return seen


def _goals(run: RunFolder, task: str, protocol: Protocol) -> Path | None:
    """Folder of the goals to play for, made if need be; None: every seed constructs its own."""
    if not find_task(task).goal_conditioned:
        return None
    if protocol.split == "validation" and protocol.goals == "constructed":
        return None
    seed = GOAL_SEED if protocol.split == "test" else FIRST_SEED["validation"]
    count = min(protocol.n_goals, protocol.episodes)
    folder = run.path / "goals" / f"{protocol.goals}-{seed}-{count}"
    made = make_goals(task, folder, count=count, seed=seed, kind=protocol.goals, workers=1)
    if made["goals"] < count:
        raise InputError(f"only {made['goals']} of {count} goals of {task} could be made")
    return folder


def _identity(run: RunFolder, step: int, protocol: Protocol) -> dict[str, Any]:
    """What the results of a protocol depend on; not on how many of its episodes were played."""
    weights = hashlib.blake2b(run.snapshot(step).read_bytes(), digest_size=8).hexdigest()
    goals = min(protocol.n_goals, protocol.episodes) if protocol.split == "test" else None
    described = {**asdict(protocol), "episodes": None, "n_goals": goals}
    return {"step": step, "weights": weights, "protocol": described, "versions": versions()}


def _path(run: RunFolder, step: int, protocol: Protocol) -> Path:
    text = json.dumps(_identity(run, step, protocol), sort_keys=True)
    key = hashlib.blake2b(text.encode(), digest_size=6).hexdigest()
    return run.evaluations / f"step_{step:08d}-{protocol.split}-{key}.json"
