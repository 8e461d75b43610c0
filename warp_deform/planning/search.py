"""Search for an action by simulation, with a budget of rollouts.

All methods begin with the candidates of the task. `enumerate` takes the best of them; `random`
tries others drawn around them; `cem`, the cross-entropy method over a mixture of picks, draws
around the best so far, ever closer; `gradient` moves the best down the slope of the task's loss by
Adam, and draws around those whose slope cannot be used. Every action that a search returns has been
tried as it would run. Two actions ahead, each of the best states is searched again.
Sources: Rubinstein, Kroese, "The Cross-Entropy Method", 2004; Kingma, Ba, "Adam", 2015.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..errors import InputError
from ..rendering.pixels import BOUNDS
from ..tasks.task import Action, Task
from ..world_state import WorldState
from .lookahead import Lookahead, Outlook

METHODS = ("enumerate", "random", "cem", "gradient")
SLOPE_COST = 4
"""Rollouts that a slope counts as: a taped one, its repetition and the backward sweep."""
MOST_GROWTH = 1e5
"""A slope whose rollout is more chaotic than that is not used."""
_LOW, _HIGH = np.array(BOUNDS[:2]).T


@dataclass(frozen=True, kw_only=True)
class SearchConfig:
    """How to search; `budget` is all that a search may spend, in rollouts of one action."""

    method: str = "cem"
    budget: int = 64
    candidates: int = 32
    """First tries, from the task."""
    elites: int = 6
    """Best tries around which `cem` draws."""
    rounds: int = 2
    """Draws of `cem`."""
    spread: float = 0.04
    """Standard deviation of drawn place points [m]; `cem` halves it every round."""
    turn_spread: float = 0.3
    """The same of the place yaw [rad], where the task has use for it."""
    steps: int = 3
    """Steps of `gradient` down the slope."""
    rate: float = 0.015
    """Length of its first steps [m]; turns go ten times as far [rad]."""
    depth: int = 2
    """Actions ahead."""
    beam: int = 3
    """States after the first action that are searched on."""

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise InputError(f"no method {self.method!r}; choose from {', '.join(METHODS)}")
        if min(self.budget, self.candidates, self.elites, self.depth, self.beam) < 1:
            raise InputError("budget, candidates, elites, depth and beam must be 1 or more")


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

    also: actions to try before the task's candidates, within the budget; of equals they come first
    With `depth` 2 and no first action that solves the task, the actions whose second action leads
    farthest come first, in the order of what that one leads to.
    """
    deep = config.depth > 1
    first = config.budget if not deep else max(1, config.budget // 2)
    tried = _around(lookahead, task, state, rng, config, first, also, keep=deep)
    tried.sort(key=lambda o: o.rank, reverse=True)
    if not deep or not tried or tried[0].solved:
        return tried
    beam = [o for o in tried if o.after is not None and o.grade >= 2][: config.beam]
    if not beam:
        return tried
    each = (config.budget - first) // len(beam)
    led = []
    for outlook in beam:
        assert outlook.after is not None
        seconds = _around(lookahead, task, outlook.after, rng, config, each, (), keep=False)
        best = max((o.rank for o in seconds), default=(0, 0.0))
        led.append((best if best > outlook.rank else outlook.rank, outlook))
    led.sort(key=lambda pair: pair[0], reverse=True)
    chosen = [outlook for _, outlook in led]
    return chosen + [o for o in tried if o not in chosen]


def _around(
    lookahead: Lookahead,
    task: Task,
    state: WorldState,
    rng: np.random.Generator,
    config: SearchConfig,
    budget: int,
    also: Sequence[Action],
    *,
    keep: bool,
) -> list[Outlook]:
    """Try up to `budget` actions from one state."""
    layout, snapshot = state.episode.layout, state.episode.snapshot
    known: set[bytes] = set()

    def fresh(actions: Sequence[Action], most: int) -> list[Action]:
        new: list[Action] = []
        for action in actions:
            if len(new) < most and action.tobytes() not in known:
                known.add(action.tobytes())
                new.append(action)
        return new

    def tries(actions: Sequence[Action], origin: str) -> list[Outlook]:
        outlooks = lookahead.try_each([(state, action) for action in actions], keep=keep)
        return [replace(outlook, origin=origin) for outlook in outlooks]

    proposed = task.candidates(layout, snapshot, rng, config.candidates)
    tried = tries(fresh([*also, *proposed], budget), "candidate")
    if config.method == "enumerate" or not tried or any(o.solved for o in tried):
        return tried
    left = budget - len(tried)
    if config.method == "gradient":
        return tried + _downhill(lookahead, task, state, rng, config, tried, left, keep=keep)
    if config.method == "random":
        around = [tried[i].action for i in rng.integers(len(tried), size=left)]
        drawn = [_drawn(a, rng, config.spread, config.turn_spread) for a in around]
        return tried + tries(drawn, "drawn")
    for k in range(config.rounds):
        if any(o.solved for o in tried):
            break
        count = left // (config.rounds - k)
        left -= count
        elites = sorted(tried, key=lambda o: o.rank, reverse=True)[: config.elites]
        around = [elites[i % len(elites)].action for i in range(count)]
        scale = 0.5**k
        drawn = [_drawn(a, rng, config.spread * scale, config.turn_spread * scale) for a in around]
        tried += tries(fresh(drawn, count), "drawn")
    return tried


def _downhill(
    lookahead: Lookahead,
    task: Task,
    state: WorldState,
    rng: np.random.Generator,
    config: SearchConfig,
    tried: Sequence[Outlook],
    budget: int,
    *,
    keep: bool,
) -> list[Outlook]:
    """Move the best of `tried` downhill, and try where they get; spends up to `budget`."""
    slopes = lookahead.slopes()
    each = SLOPE_COST * config.steps + config.steps
    elites = sorted(tried, key=lambda o: o.rank, reverse=True)[: max(1, budget // each)]
    if budget < each:
        return []
    places = np.array([o.action for o in elites])
    first, second = np.zeros((len(elites), 3)), np.zeros((len(elites), 3))
    scale = config.rate * np.array([1.0, 1.0, 10.0])
    turns = places[:, 5] != 0.0
    stuck = np.zeros(len(elites), dtype=bool)
    jobs: list[tuple[WorldState, Action]] = []
    origins: list[str] = []
    for k in range(1, config.steps + 1):
        told = slopes.of([(state, place) for place in places])
        lookahead.rollouts += SLOPE_COST * len(told)
        by_place = np.array([slope.by_place for slope in told])
        stuck |= [not slope.usable or slope.growth > MOST_GROWTH for slope in told]
        by_place[~turns, 2] = 0.0
        norms = np.linalg.norm(by_place, axis=1, keepdims=True)
        by_place = np.where(stuck[:, None], 0.0, by_place / np.maximum(norms, 1e-12))
        first = 0.8 * first + 0.2 * by_place
        second = 0.9 * second + 0.1 * by_place**2
        mean, spread = first / (1 - 0.8**k), np.sqrt(second / (1 - 0.9**k))
        places[:, 3:6] -= scale / np.sqrt(k) * mean / (spread + 1e-8)
        places[:, 3:5] = np.clip(places[:, 3:5], _LOW, _HIGH)
        for i in range(len(elites)):
            near = _drawn(elites[i].action, rng, config.spread / k, config.turn_spread / k)
            jobs.append((state, near if stuck[i] else places[i].copy()))
            origins.append("drawn" if stuck[i] else "gradient")
    outlooks = lookahead.try_each(jobs, keep=keep)
    return [replace(o, origin=origin) for o, origin in zip(outlooks, origins, strict=True)]


def _drawn(action: Action, rng: np.random.Generator, spread: float, turn: float) -> Action:
    """The same pick, placed near by; on the table."""
    near = action.copy()
    near[3:5] = np.clip(near[3:5] + rng.normal(0.0, spread, 2), _LOW, _HIGH)
    if near[5] != 0.0:
        near[5] += rng.normal(0.0, turn)
    return near
