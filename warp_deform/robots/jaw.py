"""A parallel jaw over a bead chain: two fingers that push, press, miss and grip what they meet.

Geometry decides. A bead beside a finger is pushed away, a bead under one is pressed onto the foam
and stays there, and closing fingers grip every bead that lies between them, above the lower edge of
their pads, when they stop. Held beads follow the hand rigidly; the chain drags behind.

Source of the fingers' size: the vendor's fingers as in MuJoCo Menagerie, franka_emika_panda.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from ..objects.cable import Cable

if TYPE_CHECKING:
    from ..xpbd.fused_xpbd import FusedXPBD

__all__ = ["Jaw", "JawConfig", "JawContact", "between", "squeezed_width"]

_HEAVY = 1e-6
"""Inverse mass of a held or pressed bead, relative to that of a free one."""
_LET_GO = 5e-4
"""Fingers this much wider than at the grip have let go [m]."""
_STOPPED = 1e-4
"""Fingers this near to what they squeeze have stopped at it [m]."""
_FASTEST_PUSH = 0.1
"""Speed at which a finger moves a bead out of its way, at most [m/s]."""
_SLIPS_AT = 1.25
"""A finger that stretches a link by more than a quarter loses the bead: it slips."""
_LOWEST_HOLD = 0.2
"""Share of its radius by which the pads' lower edge is below a bead's centre that they can hold."""


@dataclass(frozen=True, kw_only=True)
class JawConfig:
    """Two fingers that travel along the hand's y axis; its z axis points out of the hand."""

    pad_length: float = 0.017
    """Of a pad along the hand's x axis [m]."""
    thickness: float = 0.008
    """Of a finger along y [m]."""
    tip: float = 0.009
    """How far the fingers reach beyond the TCP along z [m]."""
    max_width: float = 0.08
    """Widest opening [m]."""
    stiffness: float = 3000.0
    """Of the ground under a fingertip [N/m]."""
    damping: float = 30.0
    """Of the ground under a fingertip that goes down [N s/m]."""
    slip: float = 0.0
    """Share of the grips that are lost on the way, at random."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not 0.0 <= value < math.inf:
                raise InputError(f"JawConfig.{field.name} must be 0 or more, got {value}")
        if not (self.pad_length > 0 and self.thickness > 0 and self.slip <= 1):
            raise InputError("JawConfig: pad_length and thickness above 0, slip at most 1")


@dataclass(frozen=True)
class JawContact:
    """What a jaw feels.

    Attributes:
        force: upwards on the hand [N]
        width: of what lies between the fingers if they squeezed it [m]; 0 where nothing does
    """

    force: float
    width: float


def between(local: np.ndarray, opening: float, *, radius: float, config: JawConfig) -> np.ndarray:
    """Numbers of the beads that fingers `opening` [m] apart would take, of those at `local` (n, 3).

    Args:
        local: centres in the hand's frame [m]; a bead counts whose centre is between the pads and
            above their lower edge
    """
    inside = (
        (np.abs(local[:, 0]) < config.pad_length / 2)
        & (np.abs(local[:, 1]) < opening / 2)
        & (local[:, 2] < config.tip - _LOWEST_HOLD * radius)
        & (local[:, 2] > config.tip - 2 * config.pad_length)
    )
    return np.flatnonzero(inside)


def squeezed_width(local: np.ndarray, numbers: np.ndarray, *, radius: float) -> float:
    """Width [m] of the beads `numbers`, at `local` (n, 3) in the hand's frame, between two pads.

    A strand is as wide as a bead; strands side by side add up, strands on top of each other do not.

    Examples:
        >>> squeezed_width(np.zeros((3, 3)), np.array([0, 1]), radius=0.5)
        1.0
    """
    if not len(numbers):
        return 0.0
    strand = np.cumsum(np.diff(numbers, prepend=numbers[0]) > 1)
    if strand[-1] == 0:
        return 2 * radius
    points = local[numbers]
    gap = np.abs(points[:, None] - points[None])
    beside = (gap[..., 0] < 1.5 * radius) & (gap[..., 2] < 1.5 * radius)
    others = [len(set(strand[row]) | {s}) for row, s in zip(beside, strand, strict=True)]
    return 2 * radius * max(others)


class Jaw:
    """The jaw of one world: `move` tells the chain what the fingers do before the solver runs.

    Args:
        solver: whose beads
        world: whose beads
        chain: whose beads
        rng: for grips that slip

    Attributes:
        held: numbers of the beads in the grip
        lost: whether a grip has slipped since the fingers last opened
    """

    def __init__(
        self,
        solver: FusedXPBD,
        world: int,
        chain: Cable,
        config: JawConfig | None = None,
        *,
        rng: np.random.Generator | None = None,
    ) -> None:
        self.config = config or JawConfig()
        if self.config.slip > 0 and rng is None:
            raise InputError("a jaw whose grips slip needs a generator")
        self._rng = rng
        rows = slice(chain.particles.start, chain.particles.stop)
        data = solver.data
        self._x = data.lane("particles.x", world)[rows]
        self._v = data.lane("particles.v", world)[rows]
        self._w = data.lane("particles.w", world)[rows]
        self._free = data.lane("particles.w0", world)[rows]
        self._gravity = data.per_world("group.gravity", world)[..., 0]
        self._dt = solver.config.dt
        self._radius, self._spacing = chain.config.radius, chain.config.spacing
        self.reset()

    def reset(self) -> None:
        """Hold nothing."""
        self.held = np.zeros(0, int)
        self.lost = False
        self._offsets = np.zeros((0, 3))
        self._pinned = self._led = np.zeros(0, int)
        self._width = 0.0
        self._hold_seconds, self._slips_after = 0.0, math.inf
        self._tip: float | None = None
        self._w[:] = self._free

    def near(self, world_T_tcp: np.ndarray) -> bool:
        """Whether the fingers hold something, or are down among the beads."""
        lowest = float(world_T_tcp[2, 3]) - self.config.tip
        return len(self.held) > 0 or lowest < float(self._x[:, 2].max()) + 4 * self._radius

    def move(
        self, world_T_tcp: np.ndarray, opening: float, *, closing: bool, steps: int
    ) -> JawContact:
        """Bring the hand to `world_T_tcp` (4, 4) [m] within the next `steps` substeps.

        Args:
            opening: of the fingers at the end [m]
            closing: whether they press
        """
        pinned, self._pinned = self._pinned, np.zeros(0, int)
        self._w[self._led] = self._free[self._led]
        self._v[self._led] = 0.0
        self._led = pinned[:0]
        seconds = steps * self._dt
        self._open(opening, seconds)
        R, t = world_T_tcp[:3, :3], world_T_tcp[:3, 3]
        if not self.near(world_T_tcp):
            self._tip = None
            return JawContact(0.0, 0.0)
        local = (self._x - t) @ R
        force = self._ground(world_T_tcp, seconds)
        if len(self.held):
            self._carry(R, t, steps)
            return JawContact(force, self._width)
        force += self._push(local, R, opening, pinned, steps)
        inside = between(local, opening, radius=self._radius, config=self.config)
        width = squeezed_width(local, inside, radius=self._radius)
        if closing and len(inside) and opening <= width + _STOPPED and not self.lost:
            self._grip(inside, local, width)
            self._carry(R, t, steps)
        return JawContact(force, width)

    def _open(self, opening: float, seconds: float) -> None:
        """Let go when the fingers open, or when the grip slips."""
        if opening > self._width + _LET_GO:
            self.lost = False
        if not len(self.held):
            return
        self._hold_seconds += seconds
        slips = self._hold_seconds > self._slips_after
        if slips or opening > self._width + _LET_GO:
            self._w[self.held] = self._free[self.held]
            self._v[self.held] = 0.0
            self.held = np.zeros(0, int)
            self.lost = slips

    def _grip(self, inside: np.ndarray, local: np.ndarray, width: float) -> None:
        self.held, self._width = inside, width
        self._offsets = local[inside].astype(np.float64)
        self._hold_seconds, self._slips_after = 0.0, math.inf
        if self._rng is not None and self._rng.random() < self.config.slip:
            self._slips_after = float(self._rng.uniform(0.2, 1.5))

    def _carry(self, R: np.ndarray, t: np.ndarray, steps: int) -> None:
        """Let held beads go with the hand."""
        self._lead(self.held, self._offsets @ R.T + t, steps)

    def _lead(self, beads: np.ndarray, targets: np.ndarray, steps: int) -> None:
        """Let `beads`, too heavy for the chain to stop, arrive at `targets` (n, 3) in time."""
        fall = self._gravity * self._dt * (steps + 1) / 2
        self._v[beads] = (targets - self._x[beads]) / (steps * self._dt) - fall
        self._w[beads] = _HEAVY * self._free[beads]

    def _ground(self, world_T_tcp: np.ndarray, seconds: float) -> float:
        """Force of the ground z = 0 on the fingertips [N]."""
        tip = float(world_T_tcp[2, 3] + self.config.tip * world_T_tcp[2, 2])
        speed = 0.0 if self._tip is None else (self._tip - tip) / seconds
        self._tip = tip
        if tip >= 0.0:
            return 0.0
        return max(-self.config.stiffness * tip + self.config.damping * speed, 0.0)

    def _strained(self) -> np.ndarray:
        """Which beads (n,) the chain pulls at so strongly that they slip from under a finger."""
        links = np.linalg.norm(np.diff(self._x, axis=0), axis=1) > _SLIPS_AT * self._spacing
        strained = np.zeros(len(self._x), bool)
        strained[1:] |= links
        strained[:-1] |= links
        return strained

    def _push(
        self, local: np.ndarray, R: np.ndarray, opening: float, before: np.ndarray, steps: int
    ) -> float:
        """Move beads out of the fingers' way, or pin those under them; returns their force [N].

        Args:
            before: numbers of the beads that were pinned so far
        """
        config, r, force = self.config, self._radius, 0.0
        half_x, half_y = config.pad_length / 2, config.thickness / 2
        depth = config.tip - (local[:, 2] - r)  # of the finger below the bead's top
        if not (depth > 0).any():
            return 0.0
        # what a finger meets of a bead's upper half is narrower
        reach = np.sqrt(np.maximum(r**2 - np.maximum(r - depth, 0.0) ** 2, 0.0))
        moved = np.zeros_like(local)
        pinned = np.zeros(len(local), bool)
        # from above a finger cannot get beside a bead
        above = depth < 1.2 * r
        above[before] = True
        for side in (1.0, -1.0):
            y = local[:, 1] - side * (opening / 2 + half_y)
            x = local[:, 0]
            over_x, over_y = half_x + reach - np.abs(x), half_y + reach - np.abs(y)
            hit = (depth > 0) & (over_x > 0) & (over_y > 0)
            if not hit.any():
                continue
            under = hit & (np.abs(x) <= half_x) & (np.abs(y) <= half_y) & above
            if under.any():
                pinned |= under
                force += config.stiffness * float(depth[under].max())
            beside = hit & ~under
            along = beside & (over_x < over_y)
            across = beside & ~along
            moved[along, 0] += np.copysign(over_x, x)[along]
            moved[across, 1] += np.copysign(over_y, y)[across]
        most = _FASTEST_PUSH * steps * self._dt
        moved = np.clip(moved, -most, most)
        moved[pinned] = 0.0
        self._pinned = np.flatnonzero(pinned)
        self._led = np.flatnonzero((pinned | moved.any(axis=1)) & ~self._strained())
        self._lead(self._led, self._x[self._led] + moved[self._led] @ R.T, steps)
        return force
