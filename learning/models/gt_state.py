"""Ground-truth baselines: from a state vector to an action, through mixtures of Gaussians.

Source: Seita et al., ICRA 2021, baselines GT-State MLP and GT-State MLP 2-Step, and what their code
does: sines and cosines of the inputs beside them, the input seen again by every layer, weights and
biases drawn from N(0, 0.05^2), mixing logits divided by 2.5, the variance raised to the fourth
power when acting. The inputs are not normalised (the original stores means and deviations, then
ignores them). No unit is dropped, while the original builds dropout of 0.1 and sets Keras' learning
phase in training.

`exact=True` keeps the original's likelihood, whose densities and probabilities are clipped to
[1e-8, 1e8] and so lose their gradient far from the data. Otherwise the same likelihood is computed
in logarithms without clipping, and (1 cm)^2 is added to every variance to bound it: without a bound
training on actions that follow from the state never settles. Acting hardly feels it, as the fourth
power leaves a standard deviation of 0.01 um. And where the place's rotation matters, sines and
cosines are those of the bodies' yaws, not of yaws / 15, which are different numbers before and
after a whole turn.

Training without `exact` sees cosines less one: those of positions are nearly 1, so that hundreds of
them act as one bias that takes steps hundreds of times as long.

An action is encoded as in the ground truth: x, y [m] and -yaw / 15 [rad], for pick and place.

The original reads the lift from the simulator. Here a network of its own chooses it, which sees the
action that was drawn: of one state a bag may be pulled or carried, and the place tells which.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from warp_deform.errors import InputError
from warp_deform.tasks.ground_truth import YAW_SCALE

__all__ = [
    "GtState",
    "GtState2Step",
    "GtStateConfig",
    "GtStateLosses",
    "LiftMLP",
    "Mixture",
    "MixtureMLP",
    "encode_action",
    "mixture_loss",
    "sample_mixture",
]

_POSE = 3
_CLIP = (1e-8, 1e8)
_LEAST_VARIANCE = 1e-4


@dataclass(frozen=True, kw_only=True)
class GtStateConfig:
    """Sizes and choices of a ground-truth baseline; the defaults are the paper's."""

    hidden: int = 128
    """Units of both hidden layers."""
    n_gaussians: int = 26
    """Gaussians of a mixture."""
    temperature: float = 2.5
    """What mixing logits are divided by."""
    one_rotation: bool = True
    """Act with yaws of 0, as in tasks where rotation does not matter."""
    lifts: tuple[float, ...] = (0.04,)
    """Lifts of the task's stages [m]; with several there is one more network that chooses."""
    yaws: tuple[int, ...] = ()
    """Columns of the state that hold a -yaw / 15 [rad] whose own sine and cosine are seen."""
    cosines_less_one: bool = False
    """See every cosine less one; the same networks, but for their biases."""
    exact: bool = False
    """The original's clipped likelihood, and its sines and cosines of yaws / 15."""

    def __post_init__(self) -> None:
        if not self.lifts:
            raise InputError("lifts: at least one is needed")


class Mixture(NamedTuple):
    """Isotropic Gaussians: log weights (B, K), means (B, K, D), variances (B, K)."""

    log_pi: Tensor
    mean: Tensor
    variance: Tensor


class _StateMLP(nn.Module):
    """Inputs (B, d), the first of them a state -> features (B, hidden + 3 d) for last layers.

    Args:
        d_seen: d
        config: sizes and choices
    """

    def __init__(self, d_seen: int, config: GtStateConfig) -> None:
        super().__init__()
        self.config = config
        seen = 3 * d_seen
        self.features = config.hidden + seen
        self.first = _linear(seen, config.hidden)
        self.second = _linear(self.features, config.hidden)
        turns = torch.ones(d_seen)
        if not config.exact:
            turns[list(config.yaws)] = -YAW_SCALE
        self.register_buffer("turns", turns, persistent=False)

    def _draw_weights(self, generator: torch.Generator) -> None:
        for parameter in self.parameters():
            nn.init.normal_(parameter, std=0.05, generator=generator)

    def _seen(self, x: Tensor) -> Tensor:
        angles = x * self.turns
        cosines = angles.cos() - 1.0 if self.config.cosines_less_one else angles.cos()
        z = torch.cat([x, cosines, angles.sin()], dim=1)
        h = torch.cat([functional.relu(self.first(z)), z], dim=1)
        return torch.cat([functional.relu(self.second(h)), z], dim=1)


class MixtureMLP(_StateMLP):
    """State (B, d) -> a mixture over (B, D).

    Args:
        d_state: d
        d_action: D
        config: sizes and choices
        generator: draws the initial weights
    """

    def __init__(
        self, d_state: int, d_action: int, *, config: GtStateConfig, generator: torch.Generator
    ) -> None:
        super().__init__(d_state, config)
        self.mean = _linear(self.features, d_action * config.n_gaussians)
        self.log_variance = _linear(self.features, config.n_gaussians)
        self.mixing = _linear(self.features, config.n_gaussians)
        self._draw_weights(generator)

    def forward(self, state: Tensor) -> Mixture:
        """The mixture of states (B, d)."""
        h = self._seen(state)
        log_pi = functional.log_softmax(self.mixing(h) / self.config.temperature, dim=1)
        variance = self.log_variance(h).exp()
        if not self.config.exact:
            variance = variance + _LEAST_VARIANCE
        return Mixture(log_pi, self.mean(h).unflatten(1, (self.config.n_gaussians, -1)), variance)


class LiftMLP(_StateMLP):
    """State (B, d) and encoded action (B, 6) -> logits (B, n_lifts).

    Args:
        d_state: d
        config: sizes and choices, two lifts or more
        generator: draws the initial weights
    """

    def __init__(self, d_state: int, *, config: GtStateConfig, generator: torch.Generator) -> None:
        super().__init__(d_state + 2 * _POSE, config)
        if not config.exact:
            self.turns[[d_state + 2, d_state + 5]] = -YAW_SCALE
        self.choose = _linear(self.features, len(config.lifts))
        self._draw_weights(generator)

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        """Logits; yaws that acting leaves out are not looked at."""
        if self.config.one_rotation:
            action = action * action.new_tensor([1.0, 1.0, 0.0] * 2)
        logits: Tensor = self.choose(self._seen(torch.cat([state, action], dim=1)))
        return logits

    @classmethod
    def of(
        cls, d_state: int, *, config: GtStateConfig, generator: torch.Generator
    ) -> LiftMLP | None:
        """The network, where there is something to choose."""
        several = len(config.lifts) > 1
        return cls(d_state, config=config, generator=generator) if several else None


def mixture_loss(mixture: Mixture, target: Tensor, *, exact: bool = False) -> Tensor:
    """Mean negative log likelihood [nat] of targets (B, D).

    `exact` clips densities, mixing weights and their sum to [1e-8, 1e8], as the original does.
    """
    log_pi, mean, variance = mixture
    d = target.shape[1]
    squared = (target[:, None] - mean).square().sum(dim=2)
    log_density = -squared / (2 * variance) - d / 2 * torch.log(2 * math.pi * variance)
    if not exact:
        return -torch.logsumexp(log_pi + log_density, dim=1).mean()
    product = log_density.exp().clamp(*_CLIP) * log_pi.exp().clamp(*_CLIP)
    return -product.sum(dim=1).clamp(*_CLIP).log().mean()


def sample_mixture(mixture: Mixture, *, rng: np.random.Generator) -> np.ndarray:
    """One draw (B, D) float64 from each mixture, its variances first raised to the fourth power."""
    pi = mixture.log_pi.double().exp().cpu().numpy()
    mean, variance = (each.double().cpu().numpy() for each in (mixture.mean, mixture.variance))
    draws = np.empty((len(pi), mean.shape[2]))
    for b, weights in enumerate(pi):
        k = rng.choice(len(weights), p=weights / weights.sum())
        draws[b] = rng.normal(mean[b, k], variance[b, k] ** 2)
    return draws


def encode_action(action: np.ndarray) -> np.ndarray:
    """Targets (B, 6) float32, x, y [m] and -yaw / 15 of pick and place, of actions (B, 7)."""
    action = np.asarray(action, dtype=float)
    if action.ndim != 2 or action.shape[1] != 7:
        raise InputError(f"action: shape (B, 7) is needed, got {action.shape}")
    return (action[:, :6] * _units()).astype(np.float32)


class GtStateLosses(NamedTuple):
    """Losses [nat] of a batch: of the action's density, and of the lift (0 where there is one)."""

    action: Tensor
    lift: Tensor

    def total(self) -> Tensor:
        """Their sum."""
        return self.action + self.lift


class GtState(nn.Module):
    """GT-State MLP: state (B, d) -> a mixture over pick and place poses at once.

    Args:
        d_state: length of the ground truth, twice that where the goal's is appended
        config: sizes and choices
        seed: of the initial weights
    """

    name: ClassVar[str] = "gt-mlp"
    sees: ClassVar[Literal["pictures", "traces", "state"]] = "state"

    def __init__(self, d_state: int, config: GtStateConfig, *, seed: int) -> None:
        super().__init__()
        self.config = config
        generator = torch.Generator().manual_seed(seed)
        self.network = MixtureMLP(d_state, 2 * _POSE, config=config, generator=generator)
        self.lift = LiftMLP.of(d_state, config=config, generator=generator)

    def forward(self, state: Tensor, target: Tensor, lift: Tensor) -> GtStateLosses:
        """Losses of states (B, d), encoded actions (B, 6) and lift indices (B,) int64."""
        loss = mixture_loss(self.network(state), target, exact=self.config.exact)
        return GtStateLosses(loss, _lift_loss(self.lift, state, target, lift))

    @torch.no_grad()
    def act(self, state: Tensor, *, rng: np.random.Generator) -> np.ndarray:
        """Actions (B, 7) float64 drawn for states (B, d).

        They may lie outside of the action space: nothing is clipped here.
        """
        draws = sample_mixture(self.network(state), rng=rng)
        return _actions(draws, self.lift, state, self.config)


class GtState2Step(nn.Module):
    """GT-State MLP 2-Step: the pick from the state, then the place from the state and the pick.

    Training feeds the demonstrated pick to the second network, acting the drawn one with a yaw of
    0. Arguments as of `GtState`.
    """

    name: ClassVar[str] = "gt-mlp-2step"
    sees: ClassVar[Literal["pictures", "traces", "state"]] = "state"

    def __init__(self, d_state: int, config: GtStateConfig, *, seed: int) -> None:
        super().__init__()
        self.config = config
        generator = torch.Generator().manual_seed(seed)
        self.pick = MixtureMLP(d_state, _POSE, config=config, generator=generator)
        self.place = MixtureMLP(d_state + _POSE, _POSE, config=config, generator=generator)
        self.lift = LiftMLP.of(d_state, config=config, generator=generator)

    def forward(self, state: Tensor, target: Tensor, lift: Tensor) -> GtStateLosses:
        """Losses of states (B, d), encoded actions (B, 6) and lift indices (B,) int64."""
        pick, place = target[:, :_POSE], target[:, _POSE:]
        second = self.place(torch.cat([state, pick], dim=1))
        loss = mixture_loss(self.pick(state), pick, exact=self.config.exact)
        loss = loss + mixture_loss(second, place, exact=self.config.exact)
        return GtStateLosses(loss, _lift_loss(self.lift, state, target, lift))

    @torch.no_grad()
    def act(self, state: Tensor, *, rng: np.random.Generator) -> np.ndarray:
        """Actions (B, 7) float64 drawn for states (B, d); see `GtState.act`."""
        pick = sample_mixture(self.pick(state), rng=rng)
        seen = pick.copy()
        seen[:, 2] = 0.0
        given = torch.from_numpy(seen).to(state)
        place = sample_mixture(self.place(torch.cat([state, given], dim=1)), rng=rng)
        return _actions(np.hstack([pick, place]), self.lift, state, self.config)


def _actions(
    draws: np.ndarray, lift: LiftMLP | None, state: Tensor, config: GtStateConfig
) -> np.ndarray:
    """Actions (B, 7) of encoded draws (B, 6) for states (B, d)."""
    choice = np.zeros(len(draws), int)
    if lift is not None:
        choice = lift(state, torch.from_numpy(draws).to(state)).argmax(dim=1).cpu().numpy()
    poses = draws / _units()
    if config.one_rotation:
        poses[:, [2, 5]] = 0.0
    return np.column_stack([poses, np.array(config.lifts)[choice]])


def _units() -> np.ndarray:
    return np.array([1.0, 1.0, -1.0 / YAW_SCALE] * 2)


def _lift_loss(lift: LiftMLP | None, state: Tensor, action: Tensor, index: Tensor) -> Tensor:
    """Loss of the lift's index (B,), given states (B, d) and encoded actions (B, 6)."""
    if lift is None:
        return state.new_zeros(())
    return functional.cross_entropy(lift(state, action), index)


def _linear(before: int, after: int) -> nn.Linear:
    """A layer whose weights are still unset, so that no global generator draws them."""
    layer: nn.Linear = nn.utils.skip_init(nn.Linear, before, after)
    return layer
