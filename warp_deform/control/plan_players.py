"""What plans of tasks made for control do, step by step: smooth motions, pushes, picks."""

from __future__ import annotations

import abc
from collections.abc import Sequence
from typing import Protocol

import numpy as np

from ..tasks.task import Layout
from .fold_fabric import CARRY_STEPS
from .modes import ControlConfig
from .push_cable import push_actions
from .smooth_plans import actions_of

__all__ = [
    "CornerPlayer",
    "FoldPlayer",
    "OpenPlayer",
    "PathPlayer",
    "Player",
    "PushPlayer",
    "SmoothPlayer",
]

_LET_GO = (0.0, 0.0, 0.0, -1.0)
"""Action of a tip that holds nothing and stays."""
_OVER, _DOWN, _CARRY, _WAIT, _GO = 12, 16, 48, 53, 60
"""Step at which the tip is over a vertex, on it, at the end of a carry, calm, and up again."""
_HOVER = 0.06
_ARC = (0.03, 0.14)
"""Least and greatest height of a carry, which is half as high as it is long [m]."""
_BEYOND = 0.005
"""Unit of how far a corner is drawn beyond its place [m]."""


class Player(Protocol):
    """Plays plans side by side: numbers in, actions in the mode "tip_delta_position" out."""

    @property
    def shape(self) -> tuple[int, int]:
        """Of the free numbers of a plan."""

    def begin(self, numbers: np.ndarray, layouts: Sequence[Layout]) -> None:
        """Begin plans with these numbers (n, *shape), one a world."""

    def rows(self, step: int, tips: np.ndarray, particle_q: np.ndarray) -> np.ndarray:
        """Actions (n, 4) of a step, with the tips at (n, 3) and the particles at (n, P, 3) [m]."""


class OpenPlayer(abc.ABC):
    """What a plan does is fixed when it begins: three numbers of every step, and a tip that holds.

    Attributes:
        shape: of the free numbers of a plan
    """

    shape: tuple[int, int]

    @abc.abstractmethod
    def moves(self, numbers: np.ndarray, layouts: Sequence[Layout]) -> np.ndarray:
        """The first three numbers (n, T, 3) of the actions of plans (n, *shape), one a world."""

    def begin(self, numbers: np.ndarray, layouts: Sequence[Layout]) -> None:
        """See `Player`."""
        self._moves = self.moves(numbers, layouts)

    def rows(self, step: int, tips: np.ndarray, particle_q: np.ndarray) -> np.ndarray:
        """See `Player`."""
        return np.pad(self._moves[:, step], ((0, 0), (0, 1)), constant_values=1.0)


class SmoothPlayer(OpenPlayer):
    """Motions that change smoothly, of a tip that holds on.

    Args:
        steps: of an episode
        knots: points in time at which the numbers are free
    """

    def __init__(self, steps: int, knots: int = 10) -> None:
        self.steps, self.shape = steps, (knots, 3)

    def moves(self, numbers: np.ndarray, layouts: Sequence[Layout]) -> np.ndarray:
        """See `OpenPlayer`; of any number of knots."""
        return actions_of(numbers, self.steps)


class PushPlayer(OpenPlayer):
    """Straight pushes of a box; numbers are where each begins, and by how much it goes [10 cm].

    They begin around the middle of the cable, as it lies at first.
    """

    def __init__(self, control: ControlConfig, pushes: int = 6) -> None:
        self.control, self.shape = control, (pushes, 4)

    def moves(self, numbers: np.ndarray, layouts: Sequence[Layout]) -> np.ndarray:
        """See `OpenPlayer`."""
        return np.stack(
            [self._actions(plan, each) for plan, each in zip(numbers, layouts, strict=True)]
        )

    def _actions(self, plan: np.ndarray, layout: Layout) -> np.ndarray:
        begins = layout.particle_q[:, :2].mean(axis=0) + 0.1 * plan[:, :2]
        ends = np.stack([begins, begins + 0.1 * plan[:, 2:]], axis=1)
        return push_actions(layout.body_q[0, :2], ends, self.control)


class PathPlayer(OpenPlayer):
    """A tip that is led straight from point to point, all of them at one height.

    Numbers are x and y of each point, from the middle between the boxes [10 cm]. Each stretch takes
    as many steps as the others.

    Args:
        held: the bead at which the tip begins
        steps: of an episode
        points: of a path
    """

    def __init__(self, control: ControlConfig, held: int, steps: int, points: int = 5) -> None:
        self.control, self.held, self.steps = control, held, steps
        self.shape = (points, 2)

    def moves(self, numbers: np.ndarray, layouts: Sequence[Layout]) -> np.ndarray:
        """See `OpenPlayer`."""
        begins = np.stack([each.particle_q[self.held, :2] for each in layouts])
        middles = np.stack([each.body_q[:, :2].mean(axis=0) for each in layouts])
        points = np.concatenate([begins[:, None], middles[:, None] + 0.1 * numbers], axis=1)
        each = self.steps // self.shape[0]
        ways = np.diff(points, axis=1) / (each * self.control.max_speed * self.control.seconds)
        ways = np.repeat(np.pad(ways, ((0, 0), (0, 0), (0, 1))), each, axis=1)
        return np.pad(ways, ((0, 0), (0, self.steps - ways.shape[1]), (0, 0)))


class FoldPlayer:
    """Picks and places of a fabric's vertices, 60 steps each, by what is seen when each begins.

    Numbers are two of the vertex that is picked and two of the place, both in the frame of the flat
    fabric, whose corners are at -1 and 1; a number beyond counts as the corner's, of places as 1.5.

    Args:
        columns: of the fabric, which lies flat at first
    """

    def __init__(self, control: ControlConfig, columns: int, picks: int) -> None:
        self.control, self.columns = control, columns
        self.shape = (picks, 4)

    def begin(self, numbers: np.ndarray, layouts: Sequence[Layout]) -> None:
        """See `Player`."""
        sheets = np.stack([layout.particle_q for layout in layouts])[..., :2]
        across = np.linspace(-1.0, 1.0, self.columns)
        nearest = np.abs(np.clip(numbers[..., :2], -1, 1)[..., None] - across).argmin(-1)
        self._vertices = nearest[..., 1] * self.columns + nearest[..., 0]
        first, along, up = (sheets[:, k] for k in (0, self.columns - 1, -self.columns))
        middle = (along + up) / 2
        to = np.clip(numbers[..., 2:], -1.5, 1.5)
        sides = (along - first)[:, None] / 2, (up - first)[:, None] / 2
        self._places = middle[:, None] + to[..., :1] * sides[0] + to[..., 1:] * sides[1]
        self._from = np.zeros((len(numbers), 3))

    def rows(self, step: int, tips: np.ndarray, particle_q: np.ndarray) -> np.ndarray:
        """See `Player`."""
        k, t = divmod(step, CARRY_STEPS)
        if k >= self._places.shape[1]:
            return np.tile(_LET_GO, (len(tips), 1))
        if t == 0:
            self._from = particle_q[np.arange(len(tips)), self._vertices[:, k]].astype(float)
        return carry_rows(t, tips, self._from, self._places[:, k], self.control)


class CornerPlayer:
    """Carries corners of a fabric to about their places in the goal, 60 steps each.

    Numbers are three a carry. The first one's size says which corner: below 2 the one that is
    farthest from its place, below 4 the next one, and so on. The others say how much farther than
    5 mm outwards, and how far sideways, from its place it is laid [5 mm]. Outwards is away from the
    middle of the places of all corners: a corner of a flat fabric that is drawn so far smooths
    creases.

    Args:
        columns: of the fabric, whose vertices have their places in the layout's `targets`
    """

    def __init__(self, control: ControlConfig, columns: int, carries: int) -> None:
        self.control, self.columns = control, columns
        self.shape = (carries, 3)

    def begin(self, numbers: np.ndarray, layouts: Sequence[Layout]) -> None:
        """See `Player`."""
        goals = np.stack([layout.targets for layout in layouts])
        self._corners = np.array([0, self.columns - 1, -self.columns, -1]) % goals.shape[1]
        self._goals = goals[:, self._corners, :2]
        outwards = self._goals - self._goals.mean(axis=1, keepdims=True)
        outwards /= np.linalg.norm(outwards, axis=2, keepdims=True)
        self._ways = np.stack([outwards, outwards[..., ::-1] * [-1.0, 1.0]], axis=2)
        self._ranks = np.minimum(np.abs(numbers[..., 0]) / 2, 3).astype(int)
        self._beyond = _BEYOND * (numbers[..., 1:] + [1.0, 0.0])
        self._from = np.zeros((len(numbers), 3))
        self._to = np.zeros((len(numbers), 2))

    def rows(self, step: int, tips: np.ndarray, particle_q: np.ndarray) -> np.ndarray:
        """See `Player`."""
        k, t = divmod(step, CARRY_STEPS)
        if k >= self._ranks.shape[1]:
            return np.tile(_LET_GO, (len(tips), 1))
        if t == 0:
            each, corners = np.arange(len(tips)), particle_q[:, self._corners].astype(float)
            away = np.linalg.norm(corners[..., :2] - self._goals, axis=2)
            chosen = (-away).argsort(axis=1)[each, self._ranks[:, k]]
            beyond = (self._beyond[:, k, :, None] * self._ways[each, chosen]).sum(axis=1)
            self._from, self._to = corners[each, chosen], self._goals[each, chosen] + beyond
        return carry_rows(t, tips, self._from, self._to, self.control)


def carry_rows(
    t: int, tips: np.ndarray, begin: np.ndarray, end: np.ndarray, control: ControlConfig
) -> np.ndarray:
    """Actions (n, 4) of step `t` of 60 of a pick at `begin` (n, 3) and a place at `end` (n, 2)."""
    goal = begin.copy()
    hold = 1.0 if _DOWN <= t < _WAIT else -1.0
    if t < _OVER:
        goal[:, 2] = _HOVER
    elif t >= _DOWN:
        u = min(1.0, (t - _DOWN) / (_CARRY - _DOWN))
        way = end - begin[:, :2]
        high = np.clip(np.linalg.norm(way, axis=1) / 2, *_ARC)
        goal[:, :2] += u * way
        goal[:, 2] = begin[:, 2] + high * np.sin(np.pi * u)
        if t >= _WAIT:
            goal[:, 2] = _HOVER
    way = (goal - tips) / (control.max_speed * control.seconds)
    way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1.0)
    return np.pad(way, ((0, 0), (0, 1)), constant_values=hold)
