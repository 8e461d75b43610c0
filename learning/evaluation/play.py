"""A policy plays episodes of a protocol, and what is taken down of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from warp_deform.envs.wrappers import stage_at
from warp_deform.episodes import Goal
from warp_deform.robots.primitive import Outcome
from warp_deform.tasks.task import Stage
from warp_deform.worlds.loop import SOLVED, Act, EpisodeRun, play
from warp_deform.worlds.worlds import Worlds

from ..policy.policy import ImagePolicy, Policy, RetryingPolicy, StatePolicy
from .failures import bag_opening, failure
from .protocol import Protocol
from .summary import PlayedEpisode

__all__ = ["Measures", "acting", "goal_distance", "observation_of", "play_policy"]


class Measures(NamedTuple):
    """What evaluation takes down of a state: score, distance to the goal, opening of a bag."""

    score: float
    goal_l2: float | None
    opening: float | None


def play_policy(
    policy: ImagePolicy | StatePolicy,
    worlds: Worlds,
    protocol: Protocol,
    seeds: Sequence[int],
    goals: Mapping[int, Goal] | None = None,
    *,
    watch: Callable[[int, Mapping[str, np.ndarray], np.ndarray], None] | None = None,
) -> Iterator[tuple[int, PlayedEpisode, EpisodeRun[Measures]]]:
    """Play episodes of a protocol in `worlds`; each is yielded, after its slot, when it is over.

    Args:
        goals: by seed, see `protocol.goals_of`; None: every seed constructs its own
        watch: called with a slot, what is seen there, and the action chosen
    """
    act = acting(policy, protocol, watch=watch)

    def measure(worlds: Worlds, slot: int) -> Measures:
        episode, distance = worlds.episodes[slot], None
        if episode.goal is not None:
            distance = goal_distance(episode.snapshot.images.color, episode.goal.color)
        return Measures(float(worlds.score(slot)), distance, bag_opening(worlds, slot))

    goal = goals.__getitem__ if goals else None
    for slot, run in play(worlds, seeds, act=act, look=measure, goals=goal):
        ended = "a motion failed" if _failed_motion(run, protocol) else run.ended or ""
        # an episode that ends for its physics has one row fewer and counts with nothing
        trusted = bool(run.rows) and len(run.rows) == len(run.actions) + 1
        distances = tuple(row.goal_l2 for row in run.rows if row.goal_l2 is not None)
        played = PlayedEpisode(
            seed=run.seed,
            success=ended == SOLVED,
            score=run.rows[-1].score if trusted else 0.0,
            actions=len(run.actions),
            reason=ended,
            failure=failure(worlds, slot, run, [row.opening for row in run.rows]),
            goal_l2=distances or None,
            enclosed=worlds.enclosed(slot) if trusted else None,
        )
        yield slot, played, run


def acting(
    policy: ImagePolicy | StatePolicy,
    protocol: Protocol,
    *,
    watch: Callable[[int, Mapping[str, np.ndarray], np.ndarray], None] | None = None,
) -> Act[Any]:
    """Who acts by a policy in `worlds.loop.play`, as a protocol has it.

    Args:
        watch: called with a slot, what is seen there, and the action chosen
    """
    stages: dict[int, Stage | None] = {}
    players: dict[int, Policy] = {}

    def act(worlds: Worlds, runs: Mapping[int, EpisodeRun[Any]]) -> dict[int, np.ndarray | None]:
        """What the policy does in every slot, one picture at a time: no neighbour changes a bit."""
        chosen: dict[int, np.ndarray | None] = {}
        for slot, run in runs.items():
            if not run.actions:
                players[slot] = _player(policy, protocol)
            if _failed_motion(run, protocol):
                chosen[slot] = None
                continue
            seen = observation_of(worlds, slot, policy)
            action = players[slot].act(seen, rng=run.rng)
            if protocol.stage_rule == "privileged":
                before = stages.get(slot) if run.actions else None
                stage = stages[slot] = stage_at(worlds, slot, action[:6], before)
                action[6] = stage.lift
            if watch is not None:
                watch(slot, seen, action)
            chosen[slot] = action
        return chosen

    return act


def _failed_motion(run: EpisodeRun[Any], protocol: Protocol) -> bool:
    """Whether an episode is over for an action that the arm could not carry out."""
    unreachable = run.outcomes[-1:] == [Outcome.UNREACHABLE.value]
    return protocol.motions_must_succeed and unreachable


def goal_distance(color: np.ndarray, goal: np.ndarray) -> float:
    """Euclidean norm of the difference of two pictures (H, W, 3) uint8, over their H x W x 3.

    Source: Seita et al., ICRA 2021, code of the evaluation; there the difference of bytes wraps
    around at 256, here it has its sign.
    """
    difference = color.astype(np.int16) - goal.astype(np.int16)
    return float(np.linalg.norm(difference.ravel().astype(float)) / difference.size)


def _player(policy: ImagePolicy | StatePolicy, protocol: Protocol) -> Policy:
    """Who plays one episode."""
    if protocol.retry and isinstance(policy, ImagePolicy):
        return RetryingPolicy(policy)
    return policy


def observation_of(
    worlds: Worlds, slot: int, policy: ImagePolicy | StatePolicy
) -> dict[str, np.ndarray]:
    """What a policy sees of a slot: `ground_truth`, or the pictures, and those of its goal."""
    episode = worlds.episodes[slot]
    if isinstance(policy, StatePolicy):
        return {"ground_truth": worlds.task.ground_truth(episode.layout, episode.snapshot)}
    images = episode.snapshot.images
    seen = {"color": images.color, "height": images.height}
    if episode.goal is not None:
        seen |= {"goal_color": episode.goal.color, "goal_height": episode.goal.height}
    return seen
