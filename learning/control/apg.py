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

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import nn

from warp_deform.control.tensor_worlds import TensorControlWorlds
from warp_deform.errors import InputError, WarpDeformError
from warp_deform.support.progress import progress_bar

from .actor import Actor, BoundedSlopes, look_around

__all__ = ["ApgConfig", "apg_update", "play", "train_apg"]

_STREAM = 11
"""Keeps the generators of this training apart from those of episodes."""
_MOST_EPISODES = 10_000
_SLACK = 0.01
"""A target may lie so far beyond a limit [m] without a penalty."""


@dataclass(frozen=True, kw_only=True)
class ApgConfig:
    """How to train by analytic gradients.

    Attributes:
        updates: of the weights
        worlds: episodes of an update
        episodes: seeds from 0 on among which an update draws
        lr: Adam's step size at first; it falls linearly to 0
        gradient_norm: longest gradient by all weights
        action_slope: longest derivative of one world's loss by one action
        press_penalty: off the reward, for each metre that a target lies beyond the tip's limits

    Raises:
        InputError: a number is out of its range.
    """

    updates: int = 600
    worlds: int = 32
    episodes: int = 512
    lr: float = 1e-3
    gradient_norm: float = 1.0
    action_slope: float = 1.0
    press_penalty: float = 2.0

    def __post_init__(self) -> None:
        for name in ("updates", "worlds", "lr", "gradient_norm", "action_slope"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise InputError(f"{name} has to be positive, not {getattr(self, name)}")
        if not self.worlds <= self.episodes <= _MOST_EPISODES:
            raise InputError(
                f"an update draws {self.worlds} of {self.episodes} episodes; episodes is at least "
                f"worlds, and at most {_MOST_EPISODES}, where seeds of tests begin"
            )


def apg_update(
    worlds: TensorControlWorlds,
    actor: Actor,
    optimizer: torch.optim.Optimizer,
    config: ApgConfig,
    *,
    update: int,
    seed: int,
) -> dict[str, float]:
    """One update of an actor's weights, counted from 1; what it came to.

    Whatever is random is drawn from (seed, update), so an interrupted training goes on as it would
    have.
    """
    # Episodes of this update
    rng = np.random.default_rng([_STREAM, seed, update])
    seeds = rng.choice(config.episodes, worlds.worlds.count, replace=False)
    worlds.reset(dict(enumerate(seeds.tolist())))
    hook = BoundedSlopes(config.action_slope, share=1.0 / worlds.worlds.count)

    # Whole episodes, with a graph
    returned = torch.zeros(worlds.worlds.count, dtype=torch.float64)
    fired = np.zeros(worlds.worlds.count, bool)
    shown = []
    for _ in range(worlds.horizon):
        seen = worlds.observe()
        shown.append(seen.detach())
        actions = actor(seen)
        if actions.requires_grad:
            actions.register_hook(hook)
        step = worlds.advance(actions)
        pressed = (worlds.beyond - _SLACK).clamp(min=0.0)
        returned = returned + step.rewards - config.press_penalty * pressed
        fired |= ~worlds.trusted

    # An episode that a guard has ended teaches nothing
    loss = -torch.where(torch.from_numpy(fired), 0.0, returned).mean()
    optimizer.param_groups[0]["lr"] = config.lr * (1.0 - (update - 1) / config.updates)
    optimizer.zero_grad()
    loss.backward()
    norm = nn.utils.clip_grad_norm_(actor.parameters(), config.gradient_norm)
    optimizer.step()
    worlds.detach()

    # Statistics are frozen within an update, so that its observations are of one kind
    actor.norm.update(torch.stack(shown))
    return {
        "loss": float(loss.detach()),
        "gradient": float(norm),
        "bounded": hook.bounded / max(hook.seen, 1),
        "unusable": float(hook.unusable),
        "guards": float(fired.sum()),
    }


def train_apg(task: str, config: ApgConfig, *, seed: int, progress: bool = False) -> Actor:
    """Train an actor for a swing; the same seed gives the same bits on one thread of torch.

    Raises:
        InputError: no derivatives are there for the task.
        WarpDeformError: the weights came to numbers that are none.
    """
    worlds = TensorControlWorlds(task, config.worlds, action_penalty=0.0)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        worlds.reset({slot: slot for slot in range(config.worlds)})
        actor = Actor(worlds.observe().shape[1])
    look_around(worlds, actor.norm, seed=seed)
    optimizer = torch.optim.Adam(actor.network.parameters(), lr=config.lr)
    bar = progress_bar(f"train {task}", config.updates, unit="updates", shown=progress)
    with bar as advance:
        for update in range(1, config.updates + 1):
            told = apg_update(worlds, actor, optimizer, config, update=update, seed=seed)
            advance()
            if not np.isfinite([told["loss"], told["gradient"]]).all():
                raise WarpDeformError(
                    f"the loss or its slope is no number after {update} updates; take a smaller lr"
                )
            advance.note = f"loss {told['loss']:.3g}, {told['guards']:.0f} guards"
            if told["unusable"]:
                advance.note += f", {told['unusable']:.0f} derivatives that are no numbers"
    return actor


@torch.no_grad()
def play(task: str, actor: Actor, seeds: Sequence[int], *, worlds: int = 32) -> np.ndarray:
    """What is left to do [m] at the ends of the episodes of seeds (N,); inf where a guard fires.

    Raises:
        InputError: there are no seeds.
    """
    if not len(seeds):
        raise InputError("there is nothing to play: give one seed or more")
    playing = TensorControlWorlds(task, worlds, action_penalty=0.0)
    left = []
    for first in range(0, len(seeds), worlds):
        some = list(seeds[first : first + worlds])
        some += some[:1] * (worlds - len(some))
        playing.reset(dict(enumerate(some)))
        for _ in range(playing.horizon):
            playing.advance(actor(playing.observe()))
        left.append(np.where(playing.trusted, playing.left.numpy(), np.inf))
    return np.concatenate(left)[: len(seeds)]
