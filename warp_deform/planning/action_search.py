"""Search for an action by simulation, with a budget of rollouts.

All methods begin with the candidates of the task. `enumerate` takes the best of them; `random`
tries others drawn around them; `cem`, the cross-entropy method over a mixture of picks, draws
around the best so far, ever closer; `gradient` moves the best down the gradient of the task's
loss by Adam, and draws around those whose gradient cannot be used or paid. Every action that a
search returns has been tried as it would run. Two actions ahead, each of the best states is
searched again.

Sources: Rubinstein, Kroese, "The Cross-Entropy Method", 2004; Kingma, Ba, "Adam", 2015.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..errors import InputError
from ..tasks.task import Action, Task
from ..worlds.state import WorldState
from .action_pairs import JOINT_COST, Pair, move_both
from .descent import Descent
from .lookahead import Lookahead, Outlook
from .places import Places

__all__ = ["GRADIENT_COST"]  # `warp_deform.planning` is the import path of the rest

METHODS = ("enumerate", "random", "cem", "gradient")
"""The methods of `search` by name."""
JOINT_STEPS = 8
"""Most steps that two actions go downhill together."""
GRADIENT_COST = 4
"""Rollouts that a gradient counts as: a taped one, its repetition and the backward sweep."""


@dataclass(frozen=True, kw_only=True)
class SearchConfig:
    """How to search; `budget` is all that a search may spend, in rollouts of one action."""

    method: str = "cem"
    budget: int = 64
    candidates: int = 16
    """First tries, from the task; `enumerate` spends the whole budget on them."""
    elites: int = 6
    """Best tries around which `cem` draws."""
    rounds: int = 2
    """Draws of `cem`."""
    spread: float = 0.04
    """Standard deviation of drawn place points [m]; `cem` halves it every round."""
    turn_spread: float = 0.3
    """The same of the place yaw [rad], where the task has use for it."""
    lifts: bool = False
    """Whether the lift moves too, within its stage; policies lift as the task does."""
    lift_spread: float = 0.02
    """Standard deviation of drawn lifts [m]."""
    steps: int = 3
    """Steps of `gradient` down the gradient."""
    rate: float = 0.015
    """Length of its first steps [m]; turns go ten times as far [rad]."""
    depth: int = 2
    """Actions ahead, 1 or 2."""
    beam: int = 3
    """States after the first action that are searched on."""
    joint: bool = False
    """Whether `gradient` moves two actions together, with half of what the second may spend."""
    polish: bool = False
    """Whether a search goes on to better actions when it has one that solves the task."""

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise InputError(f"no method {self.method!r}; choose from {', '.join(METHODS)}")
        if min(self.budget, self.candidates, self.elites, self.depth, self.beam) < 1:
            raise InputError("budget, candidates, elites, depth and beam must be 1 or more")
        if self.depth > 2:
            raise InputError(f"depth must be 1 or 2 actions ahead, got {self.depth}")


def search(
    lookahead: Lookahead,
    task: Task,
    state: WorldState,
    rng: np.random.Generator,
    config: SearchConfig,
    *,
    also: Sequence[Action] = (),
) -> list[Outlook]:
    """Outlooks tried from `state`, the best first; empty when the task has no candidate.

    With `depth` 2 and no first action that solves the task, the actions whose second action leads
    farthest come first, in the order of what that one leads to.

    Args:
        also: actions to try before the task's candidates, within the budget; of equals they come
            first
    """
    deep = config.depth > 1
    spent = lookahead.rollouts
    first = config.budget if not deep else max(1, config.budget // 2)
    around = _Around(lookahead, task, state, rng, config, keep=deep)
    tried = around.tried(first, also)
    tried.sort(key=lambda o: o.rank, reverse=True)
    if not deep or not tried:
        return tried
    if tried[0].done:
        if config.polish:
            tried += around.improved(tried, config.budget - (lookahead.rollouts - spent))
            tried.sort(key=lambda o: o.rank, reverse=True)
        return tried
    beam = [o for o in tried if o.after is not None and o.goes_on][: config.beam]
    if not beam:
        return tried
    rest = config.budget - first
    jointly = rest // 2 if config.joint and config.method == "gradient" else 0
    followed: list[Pair] = []
    for outlook in beam:
        assert outlook.after is not None
        from_there = _Around(lookahead, task, outlook.after, rng, config, keep=False)
        seconds = from_there.tried((rest - jointly) // len(beam))
        followed.append((outlook, max([outlook, *seconds], key=lambda o: o.rank)))
    followed += [(o, o) for o in tried if o.solved]  # but with an item that is not enclosed
    followed.sort(key=lambda pair: pair[1].rank, reverse=True)
    if jointly >= JOINT_COST:
        steps = min(JOINT_STEPS, jointly // JOINT_COST)
        pairs = [pair for pair in followed if pair[0] is not pair[1]][
            : jointly // (steps * JOINT_COST)
        ]
        followed += move_both(
            lookahead, task, state, pairs, around.places, steps=steps, scale=_scale(config)
        )
        followed.sort(key=lambda pair: pair[1].rank, reverse=True)
    chosen = [outlook for outlook, _ in followed]
    return chosen + [o for o in tried if o not in chosen]


def _scale(config: SearchConfig) -> np.ndarray:
    """Lengths (4,) of the first steps downhill by place x, y [m], yaw [rad], lift [m]."""
    return config.rate * np.array([1.0, 1.0, 10.0, 1.0])


class _Around:
    """Actions from one state, tried and drawn around one another.

    Args:
        keep: whether outlooks hold the state afterwards
    """

    def __init__(
        self,
        lookahead: Lookahead,
        task: Task,
        state: WorldState,
        rng: np.random.Generator,
        config: SearchConfig,
        *,
        keep: bool,
    ) -> None:
        self._lookahead, self._task, self._state = lookahead, task, state
        self._rng, self._config, self._keep = rng, config, keep
        self._known: set[bytes] = set()
        self.places = Places(
            task=task,
            spread=config.spread,
            turn_spread=config.turn_spread,
            lift_spread=config.lift_spread,
            lifts=config.lifts,
        )

    def tried(self, budget: int, also: Sequence[Action] = ()) -> list[Outlook]:
        """`also`, the task's candidates and what the method makes of them, up to `budget`."""
        episode, spent = self._state.episode, self._lookahead.rollouts
        most = budget if self._config.method == "enumerate" else self._config.candidates
        proposed = self._task.candidates(episode.layout, episode.snapshot, self._rng, most)
        tried = self._try(self._fresh([*also, *proposed], budget), "candidate")
        if not tried or self._done(tried):
            return tried
        # what is not allowed costs nothing but counts, so that a budget always ends
        spent = max(len(tried), self._lookahead.rollouts - spent)
        return tried + self.improved(tried, budget - spent)

    def improved(self, tried: Sequence[Outlook], budget: int) -> list[Outlook]:
        """More outlooks, from those around which the method looks."""
        if self._config.method == "gradient":
            return self._downhill(tried, budget)
        if self._config.method == "random":
            around = [tried[i].action for i in self._rng.integers(len(tried), size=budget)]
            return self._try([self.places.drawn(a, self._rng) for a in around], "drawn")
        return self._closer(tried, budget) if self._config.method == "cem" else []

    def _closer(self, tried: Sequence[Outlook], budget: int) -> list[Outlook]:
        """Draws of the cross-entropy method."""
        outlooks, rounds = list(tried), self._config.rounds
        for k in range(rounds):
            if self._done(outlooks):
                break
            count = budget // (rounds - k)
            budget -= count
            elites = sorted(outlooks, key=lambda o: o.rank, reverse=True)[: self._config.elites]
            around = [elites[i % len(elites)].action for i in range(count)]
            drawn = [self.places.drawn(action, self._rng, 0.5**k) for action in around]
            outlooks += self._try(self._fresh(drawn, count), "drawn")
        return outlooks[len(tried) :]

    def _downhill(self, tried: Sequence[Outlook], budget: int) -> list[Outlook]:
        """Move the best of `tried` downhill, and try where they get; spends up to `budget`."""
        config, rng = self._config, self._rng
        each = GRADIENT_COST * config.steps + config.steps
        if budget < each:  # too little for a gradient
            return self._closer(tried, budget)
        elites = sorted(tried, key=lambda o: o.rank, reverse=True)[: budget // each]
        gradients, actions = self._lookahead.gradients(), [o.action for o in elites]
        descent = Descent((len(elites), 4), _scale(config))
        stuck = [False] * len(elites)
        jobs: list[Action] = []
        origins: list[str] = []
        for k in range(1, config.steps + 1):
            of_actions = gradients.of([(self._state, action) for action in actions])
            self._lookahead.rollouts += GRADIENT_COST * len(of_actions)
            by_place = np.zeros((len(elites), 4))
            for i, action in enumerate(actions):
                gradient = self.places.gradient(of_actions[i], action)
                stuck[i] |= gradient is None
                if not stuck[i]:
                    by_place[i] = gradient
            changes = descent.step(by_place)
            for i, elite in enumerate(elites):
                near = self.places.drawn(elite.action, rng, 1 / k)
                if not stuck[i]:
                    actions[i] = self.places.moved(actions[i], changes[i], elite.action)
                jobs.append(near if stuck[i] else actions[i])
                origins.append("drawn" if stuck[i] else "gradient")
        outlooks = self._try(jobs, "")
        return [replace(o, origin=origin) for o, origin in zip(outlooks, origins, strict=True)]

    def _done(self, tried: Sequence[Outlook]) -> bool:
        return not self._config.polish and any(o.done for o in tried)

    def _fresh(self, actions: Sequence[Action], most: int) -> list[Action]:
        """Those that have not been tried from here, at most so many."""
        new: list[Action] = []
        for action in actions:
            if len(new) < most and action.tobytes() not in self._known:
                self._known.add(action.tobytes())
                new.append(action)
        return new

    def _try(self, actions: Sequence[Action], origin: str) -> list[Outlook]:
        jobs = [(self._state, action) for action in actions]
        outlooks = self._lookahead.try_each(jobs, keep=self._keep)
        return [replace(outlook, origin=origin) for outlook in outlooks]
