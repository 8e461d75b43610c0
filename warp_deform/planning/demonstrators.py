"""The demonstrators by name: who acts while episodes are collected.

`scripted` is the task's own; `visible` picks only what the tip would really meet; `mpc` (model
predictive control, over a horizon of one action) simulates the task's candidates, each from a copy
of the present state, and takes the most promising; `planner` searches two actions ahead. All see
the simulator's state.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

from ..errors import InputError
from ..tasks.task import Action
from ..worlds.loop import SLOTS, Act, EpisodeRun
from ..worlds.spaces import action_space
from ..worlds.worlds import Worlds
from . import Lookahead, Outlook, SearchConfig, lookahead_for, search

__all__ = ["DEMONSTRATORS", "demonstrator", "planner"]

CANDIDATES = 8
"""Candidates an episode and action: one group of SIMD lanes."""
MORE_CANDIDATES = 24
"""The same where the first ones would lose an item."""


def demonstrator(name: str) -> Act[Any]:
    """Who acts in `worlds.loop.play`: the demonstrator called `name`.

    What it does in an episode depends on the episode alone: its state and its generator.

    Raises:
        InputError: there is none.
    """
    if name not in DEMONSTRATORS:
        known = ", ".join(DEMONSTRATORS)
        raise InputError(f"there is no demonstrator {name!r}; there are: {known}")
    return DEMONSTRATORS[name]


def _scripted(worlds: Worlds, runs: Mapping[int, EpisodeRun[Any]]) -> dict[int, Action | None]:
    """What the task's scripted demonstrator does next, in every slot."""
    return _each(worlds, runs, worlds.task.demonstrate)


def _visible(worlds: Worlds, runs: Mapping[int, EpisodeRun[Any]]) -> dict[int, Action | None]:
    """What the task's visible demonstrator does next, in every slot."""
    return _each(worlds, runs, worlds.task.demonstrate_visible)


def _each(
    worlds: Worlds, runs: Mapping[int, EpisodeRun[Any]], choose: Callable[..., Action | None]
) -> dict[int, Action | None]:
    episodes = worlds.episodes
    return {
        slot: choose(episodes[slot].layout, episodes[slot].snapshot, run.rng)
        for slot, run in runs.items()
    }


def _mpc(worlds: Worlds, runs: Mapping[int, EpisodeRun[Any]]) -> dict[int, Action | None]:
    """The candidate with the best outlook in every slot; of equals the one proposed first.

    Where even the best would end the episode with an item outside of the bag, more are tried.
    """
    best: dict[int, Outlook] = {}
    for slot, outlook in _outlooks(worlds, runs, CANDIDATES):
        if slot not in best or outlook.rank > best[slot].rank:
            best[slot] = outlook
    poor = {slot: run for slot, run in runs.items() if slot in best and best[slot].ends_badly}
    for slot, outlook in _outlooks(worlds, poor, MORE_CANDIDATES):
        if outlook.rank > best[slot].rank:
            best[slot] = outlook
    return {slot: best[slot].action if slot in best else None for slot in runs}


def _outlooks(
    worlds: Worlds, runs: Mapping[int, EpisodeRun[Any]], count: int
) -> Iterator[tuple[int, Outlook]]:
    """Slots and what up to `count` candidates lead to there."""
    slots, jobs = [], []
    for slot, run in runs.items():
        for action in _candidates(worlds, slot, run, count):
            slots.append(slot)
            jobs.append((worlds.state(slot), action))
    return zip(slots, _lookahead(worlds).try_each(jobs), strict=True)


def _candidates(worlds: Worlds, slot: int, run: EpisodeRun[Any], count: int) -> list[Action]:
    """Different candidates of the task that the environments allow, at most `count`."""
    episode = worlds.episodes[slot]
    proposed = worlds.task.candidates(episode.layout, episode.snapshot, run.rng, count)
    different = {action.tobytes(): action for action in proposed}
    return [action for action in different.values() if action_space().contains(action)][:count]


def planner(config: SearchConfig) -> Act[Any]:
    """Who takes, in every slot, the best action of a search."""

    def act(worlds: Worlds, runs: Mapping[int, EpisodeRun[Any]]) -> dict[int, Action | None]:
        chosen: dict[int, Action | None] = {}
        for slot, run in runs.items():
            state = worlds.state(slot)
            outlooks = search(_lookahead(worlds), worlds.task, state, run.rng, config)
            chosen[slot] = outlooks[0].action if outlooks else None
        return chosen

    return act


def _lookahead(worlds: Worlds) -> Lookahead:
    # a search has more candidates than fill one group, and threads share groups
    count = CANDIDATES * min(max(2, worlds.count), SLOTS)
    return lookahead_for(worlds.task, worlds.robot.name, worlds.precision, count)


DEMONSTRATORS: dict[str, Act[Any]] = {
    "scripted": _scripted,
    "visible": _visible,
    "mpc": _mpc,
    "planner": planner(SearchConfig()),
}
"""The demonstrators by name."""
