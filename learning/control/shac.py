"""SHAC: a policy by short-horizon actor-critic. One file, read from top to bottom.

    for every update
        reset W worlds to episodes that the update draws
        until they are over
            for H control steps: act with noise, and add the reward; all of it has a graph
            a target critic's value of the last state stands for what follows
            bound each action's derivative, descend the loss -(rewards + value), cut the graph
            teach the critic the TD(lambda) returns of these steps
            let the target critic follow the critic

Through a long episode derivatives grow; through H steps they stay tame, and the critic is smooth.

An episode that is over has the value 0 also where its time is up: the time that is left is seen,
and what counts has been paid. Worlds begin together and nothing goes on from one update to the
next but weights, so that an interrupted training can go on with the same bits. In the source a
world that is over begins again at once.

Source: Xu et al., "Accelerated Policy Learning with Parallel Differentiable Simulation", ICLR 2022
(SHAC), and its code, DiffRL, for the numbers. Bounds on each action's derivative are ours.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from warp_deform.control.tensor_worlds import TensorControlWorlds
from warp_deform.support.checked import BELOW_ONE, COUNT, POSITIVE, SHARE, check_fields

from .actor import Actor, BoundedSlopes, as_actions, layers, look_around, pressed
from .checkpoint import put_back, tensors_of

__all__ = ["Critic", "Shac", "ShacConfig", "td_lambda"]

_STREAM = 17
"""Keeps the generators of this training apart from those of episodes."""


@dataclass(frozen=True, kw_only=True)
class ShacConfig:
    """How to train by short horizons.

    Attributes:
        window: control steps H whose derivatives are taken
        lr: Adam's step size of the actor at first; it falls linearly to 0
        critic_lr: the same of the critic
        betas: of both
        noise: spread of what is added to the actor's numbers, at first; it is learnt
        discount: of a reward one step later
        trace: lambda of TD(lambda)
        passes: of the critic over the states of a window, in `batches` parts
        batches: see `passes`
        keep: share of the target critic that is kept after a window
        gradient_norm: longest gradient by all weights
        action_slope: longest derivative of one world's loss by one action
        press_penalty: off the reward, for each metre that a target lies beyond the tip's limits

    Raises:
        InputError: a number is out of its range.
    """

    window: int = 10
    lr: float = 1e-3
    critic_lr: float = 2e-3
    betas: tuple[float, float] = (0.7, 0.95)
    noise: float = 0.05
    discount: float = 1.0
    trace: float = 0.95
    passes: int = 8
    batches: int = 4
    keep: float = 0.2
    gradient_norm: float = 1.0
    action_slope: float = 1.0
    press_penalty: float = 2.0

    def __post_init__(self) -> None:
        allowed = {"discount": SHARE, "trace": SHARE, "keep": BELOW_ONE}
        allowed |= dict.fromkeys(("window", "passes", "batches"), COUNT)
        others = [name for name in vars(self) if name not in ("betas", *allowed)]
        check_fields(self, allowed | dict.fromkeys(others, POSITIVE))


class Critic(nn.Module):
    """Normalised observations (..., D) in, what is still to be earned (...) out."""

    def __init__(self, size: int, hidden: tuple[int, ...] = (64, 64)) -> None:
        super().__init__()
        self.network = layers((size, *hidden, 1))

    def forward(self, normal: Tensor) -> Tensor:
        """Values (...)."""
        values: Tensor = self.network(normal)[..., 0]
        return values


def td_lambda(rewards: Tensor, values: Tensor, *, discount: float, trace: float) -> Tensor:
    """Returns (T, W) that mix those after 1, 2, ... T steps, with weights that fall by `trace`.

    Args:
        rewards: of T steps (T, W)
        values: of the states after them (T, W), 0 where the episode is over

    Source: Sutton and Barto, Reinforcement Learning (2018), section 12.3.
    """
    after, returns = values[-1], []
    for reward, value in zip(rewards.flip(0), values.flip(0), strict=True):
        after = reward + discount * ((1.0 - trace) * value + trace * after)
        returns.append(after)
    return torch.stack(returns).flip(0)


class Shac:
    """An actor and a critic in training. The same seed gives the same bits on one thread of torch.

    Whatever is random in an update is drawn from (seed, update), so an interrupted training goes on
    as it would have, from `tensors`.

    Args:
        worlds: that play, without a penalty on actions
        episodes: seeds from 0 on among which an update draws
        updates: after which step sizes are 0
    """

    def __init__(
        self,
        worlds: TensorControlWorlds,
        config: ShacConfig,
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
            size = worlds.observe().shape[1]
            self.actor, self.critic = Actor(size), Critic(size)
        look_around(worlds, self.actor.norm, seed=seed)
        self.target = copy.deepcopy(self.critic)
        self.noise = nn.ParameterList([torch.full((3,), float(np.log(config.noise)))])
        acting = [*self.actor.network.parameters(), *self.noise]
        self.optimizer = torch.optim.Adam(acting, lr=config.lr, betas=config.betas)
        self.critic_optimizer = torch.optim.Adam(
            self.critic.parameters(), lr=config.critic_lr, betas=config.betas
        )
        self._modules: dict[str, nn.Module] = {
            "actor": self.actor, "noise": self.noise, "critic": self.critic, "target": self.target
        }  # fmt: skip
        self._optimizers = {"actor": self.optimizer, "critic": self.critic_optimizer}

    def tensors(self) -> dict[str, Tensor]:
        """All that the next update goes on from, by name."""
        return tensors_of(self._modules, self._optimizers)

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Put back what `tensors` gave.

        Raises:
            InputError: names or shapes are others.
        """
        put_back(tensors, self._modules, self._optimizers)

    def update(self, number: int) -> dict[str, float]:
        """One update: episodes in W worlds, and after every window a step; what it came to."""
        # Episodes and noise of this update
        worlds, count = self.worlds, self.worlds.worlds.count
        rng = np.random.default_rng([_STREAM, self.seed, number])
        seeds = rng.choice(self.episodes, count, replace=False)
        worlds.reset(dict(enumerate(seeds.tolist())))
        draws = torch.Generator().manual_seed(int(rng.integers(2**31)))
        hook = BoundedSlopes(self.config.action_slope, share=1.0 / count)
        falls = 1.0 - (number - 1) / self.updates
        self.optimizer.param_groups[0]["lr"] = falls * self.config.lr
        self.critic_optimizer.param_groups[0]["lr"] = falls * self.config.critic_lr

        # Window by window until all episodes are over
        shown: list[Tensor] = []
        told: list[dict[str, float]] = []
        while worlds.running.any():
            told.append(self._window(draws, hook, shown))

        # Statistics are frozen within an update, so that its observations are of one kind
        self.actor.norm.update(torch.cat(shown))
        return {
            "loss": sum(each["loss"] for each in told),
            "critic": float(np.mean([each["critic"] for each in told])),
            "gradient": max(each["gradient"] for each in told),
            "noise": float(self.noise[0].detach().exp().mean()),
            "bounded": hook.bounded / max(hook.seen, 1),
            "unusable": float(hook.unusable),
            "guards": float((~worlds.trusted).sum()),
        }

    def _window(
        self, draws: torch.Generator, hook: BoundedSlopes, shown: list[Tensor]
    ) -> dict[str, float]:
        """Act, descend and cut the graph; then teach the critic."""
        worlds, config, norm = self.worlds, self.config, self.actor.norm
        running, seen = torch.from_numpy(worlds.running), worlds.observe()
        earned = torch.zeros(len(running), dtype=torch.float64)
        states, lived, rewards = [norm(seen).detach()], [running], []

        # H control steps, with a graph
        for step in range(config.window):
            shown.append(seen.detach()[running])
            moves = self.actor.moves(seen)
            moves = moves + self.noise[0].exp() * torch.randn(moves.shape, generator=draws)
            actions = as_actions(moves)
            actions.register_hook(hook)
            done = worlds.advance(actions)
            reward = done.rewards - config.press_penalty * pressed(worlds)
            reward = torch.where(running, reward, 0.0)
            earned = earned + config.discount**step * reward
            running, seen = torch.from_numpy(worlds.running), worlds.observe()
            states.append(norm(seen).detach())
            lived.append(running)
            rewards.append(reward.detach().float())
            if not running.any():
                break

        # The actor; what a guard has ended teaches nothing
        follows = torch.where(running, self.target(norm(seen)), 0.0)
        earned = earned + config.discount ** len(rewards) * follows
        loss = -torch.where(torch.from_numpy(~worlds.trusted), 0.0, earned).mean()
        self.optimizer.zero_grad()
        loss.backward()
        acting = self.optimizer.param_groups[0]["params"]
        gradient = nn.utils.clip_grad_norm_(acting, config.gradient_norm)
        self.optimizer.step()
        worlds.detach()

        # The critic, of states in which an episode went on
        seen_by_critic, rows = torch.stack(states), torch.stack(lived)
        with torch.no_grad():
            values = torch.where(rows[1:], self.target(seen_by_critic[1:]), 0.0)
        returns = td_lambda(
            torch.stack(rewards), values, discount=config.discount, trace=config.trace
        )
        wrong = self._teach(seen_by_critic[:-1][rows[:-1]], returns[rows[:-1]], draws)
        with torch.no_grad():
            for slow, fast in zip(self.target.parameters(), self.critic.parameters(), strict=True):
                slow.lerp_(fast, 1.0 - config.keep)
        return {"loss": float(loss.detach()), "gradient": float(gradient), "critic": wrong}

    def _teach(self, states: Tensor, returns: Tensor, draws: torch.Generator) -> float:
        """Fit the critic to returns (n,) of normalised states (n, D); its last mean square."""
        wrong = torch.zeros(())
        for _ in range(self.config.passes):
            order = torch.randperm(len(states), generator=draws)
            for part in order.chunk(self.config.batches):
                wrong = ((self.critic(states[part]) - returns[part]) ** 2).mean()
                self.critic_optimizer.zero_grad()
                wrong.backward()
                nn.utils.clip_grad_norm_(self.critic.parameters(), self.config.gradient_norm)
                self.critic_optimizer.step()
        return float(wrong.detach())
