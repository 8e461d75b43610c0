"""APG: a policy by analytic gradients of whole episodes. One file, read from top to bottom.

    for every update
        reset W worlds to episodes that the update draws
        for every control step: act, and add the reward to the return; all of it has a graph
        bound each action's derivative, descend the loss -return

There is no critic and no sampling: the return is a differentiable function of the weights. Rewards
of "dense" sum to the progress that an episode has made, 1 where nothing is left to do.

Sources: Analytic policy gradients as in Freeman et al., "Brax" (2021), and in the DiffRL suite of
Xu et al., ICLR 2022, where it is called BPTT. Bounds on each action's derivative are ours.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from warp_deform.control.tensor_worlds import TensorControlWorlds
from warp_deform.support.checked import POSITIVE, check_fields

from .actor import Actor, BoundedSlopes, look_around, pressed
from .checkpoint import put_back, tensors_of

__all__ = ["Apg", "ApgConfig"]

_STREAM = 11
"""Keeps the generators of this training apart from those of episodes."""


@dataclass(frozen=True, kw_only=True)
class ApgConfig:
    """How to train by analytic gradients.

    Attributes:
        lr: Adam's step size at first; it falls linearly to 0
        gradient_norm: longest gradient by all weights
        action_slope: longest derivative of one world's loss by one action
        press_penalty: off the reward, for each metre that a target lies beyond the tip's limits

    Raises:
        InputError: a number is not positive.
    """

    lr: float = 1e-3
    gradient_norm: float = 1.0
    action_slope: float = 1.0
    press_penalty: float = 2.0

    def __post_init__(self) -> None:
        check_fields(self, dict.fromkeys(vars(self), POSITIVE))


class Apg:
    """An actor in training. The same seed gives the same bits on one thread of torch.

    Whatever is random in an update is drawn from (seed, update), so an interrupted training goes on
    as it would have, from `tensors`.

    Args:
        worlds: that play, without a penalty on actions
        episodes: seeds from 0 on among which an update draws
        updates: after which the step size is 0
    """

    def __init__(
        self,
        worlds: TensorControlWorlds,
        config: ApgConfig,
        *,
        episodes: int,
        updates: int,
        seed: int,
    ) -> None:
        self.worlds, self.config, self.seed = worlds, config, seed
        self.episodes, self.updates = episodes, updates
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            worlds.reset({slot: slot for slot in range(worlds.worlds.count)})
            self.actor = Actor(worlds.observe().shape[1])
        look_around(worlds, self.actor.norm, seed=seed)
        self.optimizer = torch.optim.Adam(self.actor.network.parameters(), lr=config.lr)

    def tensors(self) -> dict[str, Tensor]:
        """All that the next update goes on from, by name."""
        return tensors_of({"actor": self.actor}, {"actor": self.optimizer})

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Put back what `tensors` gave.

        Raises:
            InputError: names or shapes are others.
        """
        put_back(tensors, {"actor": self.actor}, {"actor": self.optimizer})

    def update(self, number: int) -> dict[str, float]:
        """One update of the weights, counted from 1; what it came to."""
        # Episodes of this update
        worlds, config, count = self.worlds, self.config, self.worlds.worlds.count
        rng = np.random.default_rng([_STREAM, self.seed, number])
        seeds = rng.choice(self.episodes, count, replace=False)
        worlds.reset(dict(enumerate(seeds.tolist())))
        hook = BoundedSlopes(config.action_slope, share=1.0 / count)

        # Whole episodes, with a graph
        returned = torch.zeros(count, dtype=torch.float64)
        shown = []
        while worlds.running.any():
            running = torch.from_numpy(worlds.running)
            seen = worlds.observe()
            shown.append(seen.detach()[running])
            actions = self.actor(seen)
            actions.register_hook(hook)
            step = worlds.advance(actions)
            reward = step.rewards - config.press_penalty * pressed(worlds)
            returned = returned + torch.where(running, reward, 0.0)

        # An episode that a guard has ended teaches nothing
        fired = ~worlds.trusted
        loss = -torch.where(torch.from_numpy(fired), 0.0, returned).mean()
        self.optimizer.param_groups[0]["lr"] = config.lr * (1.0 - (number - 1) / self.updates)
        self.optimizer.zero_grad()
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.actor.network.parameters(), config.gradient_norm)
        self.optimizer.step()
        worlds.detach()

        # Statistics are frozen within an update, so that its observations are of one kind
        self.actor.norm.update(torch.cat(shown))
        return {
            "loss": float(loss.detach()),
            "gradient": float(norm),
            "bounded": hook.bounded / max(hook.seen, 1),
            "unusable": float(hook.unusable),
            "guards": float(fired.sum()),
        }
