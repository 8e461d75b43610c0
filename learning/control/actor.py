"""The network of control, and the statistics that normalise what it sees."""

from __future__ import annotations

import itertools

import numpy as np
import torch
from torch import Tensor, nn

from warp_deform.control.smooth_plans import smooth_plan
from warp_deform.control.tensor_worlds import TensorControlWorlds
from warp_deform.errors import InputError

__all__ = [
    "Actor",
    "BoundedSlopes",
    "PlanActor",
    "RunningNorm",
    "as_actions",
    "layers",
    "look_around",
    "pressed",
]

_STREAM = 13
"""Keeps the generator of `look_around` apart from others."""
_QUIET = 0.1
"""Of an actor's last weights, what is left before training."""
_LIFT = (0.0, 0.0, 0.5)
"""What an actor does before training."""
_SLACK = 0.01
"""A target may lie so far beyond a limit [m] without a penalty."""
_CLIP = 10.0
"""Normalised numbers are kept within so many standard deviations."""


class RunningNorm(nn.Module):
    """Mean and spread of all that was shown to `update`; `forward` normalises by them.

    Args:
        size: numbers of an observation
    """

    count: Tensor
    mean: Tensor
    square: Tensor

    def __init__(self, size: int) -> None:
        super().__init__()
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("square", torch.zeros(size, dtype=torch.float64))

    @torch.no_grad()
    def update(self, seen: Tensor) -> None:
        """Count observations (..., D) in."""
        rows = seen.detach().reshape(-1, seen.shape[-1]).double()
        total = self.count + len(rows)
        away = rows.mean(dim=0) - self.mean
        spread = ((rows - rows.mean(dim=0)) ** 2).sum(dim=0)
        self.square += spread + away**2 * self.count * len(rows) / total
        self.mean += away * len(rows) / total
        self.count += len(rows)

    def forward(self, seen: Tensor) -> Tensor:
        """Observations (..., D) with mean 0 and spread 1."""
        # what never changes stays 0, and does not blow up
        spread = (self.square / self.count.clamp(min=1.0)).sqrt().clamp(min=1e-3)
        return ((seen.double() - self.mean) / spread).clamp(-_CLIP, _CLIP).float()


def layers(sizes: tuple[int, ...]) -> nn.Sequential:
    """A network of these widths, with ELU in between."""
    parts: list[nn.Module] = []
    for before, after in itertools.pairwise(sizes):
        parts += [nn.Linear(before, after), nn.ELU()]
    return nn.Sequential(*parts[:-1])


class Actor(nn.Module):
    """Observations in, actions of "tip_delta_position" out: the tip's move, and hold at 1.

    Args:
        size: numbers of an observation
        hidden: of the layers in between
    """

    def __init__(self, size: int, hidden: tuple[int, ...] = (256, 256)) -> None:
        super().__init__()
        self.norm = RunningNorm(size)
        self.network = layers((size, *hidden, 3))
        # at first it lifts: in the air slopes are tame, and against the table there are none
        last = self.network[-1]
        assert isinstance(last, nn.Linear)
        with torch.no_grad():
            last.weight *= _QUIET
            last.bias.copy_(torch.tensor(_LIFT))

    def moves(self, seen: Tensor) -> Tensor:
        """The network's numbers (W, 3) before they are bounded."""
        numbers: Tensor = self.network(self.norm(seen))
        return numbers

    def forward(self, seen: Tensor) -> Tensor:
        """Actions (W, 4): u / sqrt(1 + |u|^2), of a length below 1, and 1."""
        return as_actions(self.moves(seen))


class PlanActor(nn.Module):
    """The first observation of an episode in, its actions out, step by step: it looks no further.

    Args:
        size: numbers of an observation, the last of which says how much of the episode is over
        hidden: of the layers in between
        steps: of an episode T
    """

    def __init__(self, size: int, hidden: tuple[int, ...] = (256, 256, 256), *, steps: int) -> None:
        super().__init__()
        self.steps = steps
        self.norm = RunningNorm(size)
        self.network = layers((size, *hidden, 3 * steps))
        last = self.network[-1]
        assert isinstance(last, nn.Linear)
        with torch.no_grad():
            last.weight *= _QUIET
            last.bias.copy_(torch.tensor(_LIFT).repeat(steps))
        self._plans: Tensor | None = None

    def plans(self, first: Tensor) -> Tensor:
        """Numbers (W, T, 3) of the moves of episodes that begin so (W, D), not yet bounded."""
        numbers: Tensor = self.network(self.norm(first))
        return numbers.reshape(len(first), self.steps, 3)

    def forward(self, seen: Tensor) -> Tensor:
        """Actions (W, 4) of the plans that began with each row's first observation.

        Raises:
            InputError: it was not shown how an episode begins.
        """
        step = (seen[:, -1] * self.steps).round().long().clamp(0, self.steps - 1)
        begins = step == 0
        if self._plans is None or len(self._plans) != len(seen):
            if not begins.all():
                raise InputError("a plan begins with its episode: show its first observation")
            self._plans = self.plans(seen)
        elif begins.any():
            self._plans = torch.where(begins[:, None, None], self.plans(seen), self._plans)
        return as_actions(self._plans[torch.arange(len(seen)), step])


def as_actions(moves: Tensor) -> Tensor:
    """Actions (W, 4) of unbounded numbers (W, 3)."""
    bounded = moves / (1.0 + (moves**2).sum(dim=-1, keepdim=True)).sqrt()
    return torch.cat([bounded, torch.ones_like(bounded[:, :1])], dim=-1)


def look_around(worlds: TensorControlWorlds, norm: RunningNorm, *, seed: int) -> None:
    """Show statistics what swings at random look like, before there is a policy to look at."""
    rng = np.random.default_rng([_STREAM, seed])
    count, steps = worlds.worlds.count, worlds.horizon
    worlds.reset({slot: slot for slot in range(count)})
    plans = np.stack([smooth_plan(rng, steps) for _ in range(count)], axis=1)
    with torch.no_grad():
        for moves in plans:
            norm.update(worlds.observe())
            worlds.advance(torch.from_numpy(np.pad(moves, ((0, 0), (0, 1)), constant_values=1.0)))


def pressed(worlds: TensorControlWorlds) -> Tensor:
    """How far the last targets (W,) lay beyond the tips' limits, more than a little [m].

    What presses against a limit has no slope there; a penalty has.
    """
    return (worlds.beyond - _SLACK).clamp(min=0.0)


class BoundedSlopes:
    """A hook for actions (W, A): each world's derivative gets at most the length `most`.

    One chaotic world would outweigh all others. What is not finite counts as 0, and is counted.

    Args:
        most: of the derivative of one world's loss by its action
        share: of one world in the loss, 1 / W where it is a mean
    """

    def __init__(self, most: float, share: float) -> None:
        self._most = most * share
        self.unusable = self.bounded = self.seen = 0

    def __call__(self, slopes: Tensor) -> Tensor:
        """The derivatives (W, A), bounded."""
        finite = torch.isfinite(slopes).all(dim=-1, keepdim=True)
        slopes = torch.where(finite, slopes, 0.0)
        length = slopes.norm(dim=-1, keepdim=True)
        self.seen += len(slopes)
        self.unusable += int((~finite).sum())
        self.bounded += int((length > self._most).sum())
        return slopes * (self._most / length.clamp(min=self._most))
