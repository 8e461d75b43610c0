"""Behaviour cloning of demonstrations at 20 Hz, in chunks. One file, read from top to bottom.

    for every update
        draw rows of demonstrations: what was seen, and the K actions that followed
        propose several chunks for what was seen, descend the absolute error of the nearest one
    in every control step
        take the likeliest proposal, and act as the mean of what this and earlier chunks say of now

Chunks keep a policy from standing still where demonstrators pause, and the mean over chunks
(temporal ensembling) makes its motion smooth. It sees the state, not pictures, as `features` tell
it, by an MLP. Demonstrators who pick now here and now there are not averaged into a place between:
each proposal is free to follow one of them.

Source: Zhao et al., "Learning Fine-Grained Bimanual Manipulation with Low-Cost Hardware" (ACT),
RSS 2023: chunks, temporal ensembling with weights exp(-m i), the absolute error. Its transformer
and its variational code are left out. Proposals: Rupprecht et al., "Learning in an Uncertain World:
Representing Ambiguity Through Multiple Hypotheses", ICCV 2017.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from warp_deform.collecting.control_episodes import (
    ControlEpisode,
    ControlSetup,
    control_worlds,
    observed,
    play_control_episodes,
)
from warp_deform.collecting.control_replay import setup_of
from warp_deform.control.numbers import recorded_numbers
from warp_deform.episodes import Episode, EpisodeReader
from warp_deform.errors import InputError
from warp_deform.support.checked import POSITIVE, check_fields
from warp_deform.worlds.loop import SOLVED

from .actor import RunningNorm, layers
from .features import StateSizes, relative_features

__all__ = [
    "ChunkPolicy",
    "Chunks",
    "Cloner",
    "CloningConfig",
    "PlayedClone",
    "ensembled",
    "play_clone",
    "read_chunks",
]

_OTHERS = 0.05
"""Share of the loss that all proposals have in common, so that none is left behind."""
_LIKELY = 0.02
"""Weight of the loss of which proposal will be nearest."""
_STREAM = 17
"""Keeps the generators of this training apart from those of episodes."""


@dataclass(frozen=True, kw_only=True)
class CloningConfig:
    """How to clone demonstrations.

    Attributes:
        updates: of the weights
        batch: rows of an update
        chunk: actions that are predicted at once
        lr: Adam's step size at first; it falls linearly to 0
        noise: standard deviation of noise on normalised observations while training
        proposals: chunks that are proposed for what is seen
        decay: m in the weights exp(-m i) of chunks, i from the oldest one on

    Raises:
        InputError: a number is not above 0.
    """

    updates: int = 20000
    batch: int = 256
    chunk: int = 10
    lr: float = 1e-3
    noise: float = 0.05
    proposals: int = 4
    decay: float = 0.01

    def __post_init__(self) -> None:
        check_fields(self, dict.fromkeys(self.__dataclass_fields__, POSITIVE))


@dataclass(frozen=True, eq=False)
class Chunks:
    """Rows of demonstrations.

    Attributes:
        seen: observations "state" (N, D) float32
        actions: that followed (N, K, A) float32; beyond an episode's end its last one, unmoving
        sizes: what an observation consists of
        how: how the tips of all of them were led
    """

    seen: Tensor
    actions: Tensor
    sizes: StateSizes
    how: ControlSetup


def read_chunks(folder: Path, chunk: int) -> Chunks:
    """The rows of a folder of demonstrations at 20 Hz.

    Raises:
        InputError: it holds picks and places, or tips that were led in several ways.
    """
    seen, following, ways, sizes = [], [], set(), set()
    for episode in EpisodeReader(folder, control=True):
        ways.add(setup_of(episode.info))
        numbers = recorded_numbers(episode)
        sizes.add(_sizes(episode))
        actions = np.array([s.action for s in episode.steps if s.action is not None], np.float32)
        still = actions[-1:].copy()
        still[:, :-1] = 0.0
        padded = np.concatenate([actions, np.repeat(still, chunk, axis=0)])
        at = np.arange(len(actions))[:, None] + np.arange(chunk)
        seen.append(numbers[: len(actions)])
        following.append(padded[at])
    if len(ways) != 1:
        raise InputError(f"{folder} holds tips that were led in {len(ways)} ways; clone one")
    if len(sizes) != 1:
        raise InputError(f"{folder} holds episodes with other objects in each; clone one kind")
    return Chunks(
        sizes=sizes.pop(),
        seen=torch.from_numpy(np.concatenate(seen)),
        actions=torch.from_numpy(np.concatenate(following)),
        how=ways.pop(),
    )


def _sizes(episode: Episode) -> StateSizes:
    first, record = episode.steps[0], episode.info.control
    assert record is not None, "it was read as one of control"
    goal = np.shape(record.goal)
    return StateSizes(len(first.particle_q), len(first.body_q), goal if np.prod(goal) else ())


class ChunkPolicy(nn.Module):
    """Observations in, chunks of actions out.

    Args:
        sizes: what an observation consists of
        chunk: actions of a chunk
        width: numbers of an action
        proposals: chunks that are proposed
        hidden: of the layers in between
    """

    def __init__(
        self,
        sizes: StateSizes,
        chunk: int,
        width: int,
        proposals: int = CloningConfig.proposals,
        hidden: tuple[int, ...] = (256, 256),
    ) -> None:
        super().__init__()
        self.sizes, self.shape = sizes, (proposals, chunk, width)
        features = relative_features(torch.zeros(1, sizes.numbers), sizes).shape[1]
        self.norm = RunningNorm(features)
        self.network = layers((features, *hidden, proposals * chunk * width + proposals))

    def look_at(self, seen: Tensor) -> None:
        """Take observations (N, D) for what is normal."""
        self.norm.update(relative_features(seen, self.sizes))

    def propose(self, seen: Tensor, noise: float = 0.0) -> tuple[Tensor, Tensor]:
        """Chunks (W, M, K, A) for observations (W, D), and logits (W, M) of which is nearest."""
        normed = self.norm(relative_features(seen, self.sizes))
        if noise:
            normed = normed + noise * torch.randn_like(normed)
        out = self.network(normed)
        count = self.shape[0]
        return out[:, count:].unflatten(-1, self.shape), out[:, :count]

    def forward(self, seen: Tensor) -> Tensor:
        """The likeliest chunks (W, K, A) for observations (W, D)."""
        chunks, likely = self.propose(seen)
        return chunks[torch.arange(len(seen)), likely.argmax(dim=1)]


class Cloner:
    """A policy in training; the same seed gives the same bits on one thread of torch."""

    def __init__(self, chunks: Chunks, config: CloningConfig, *, seed: int) -> None:
        self._chunks, self._config, self._seed = chunks, config, seed
        chunk, width = chunks.actions.shape[1:]
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.policy = ChunkPolicy(chunks.sizes, chunk, width, config.proposals)
        self.policy.look_at(chunks.seen)
        self._adam = torch.optim.Adam(self.policy.network.parameters(), lr=config.lr)

    def update(self, number: int) -> float:
        """One update of the weights, counted from 1; its loss.

        What is random is drawn from the seed and the number.
        """
        config, chunks = self._config, self._chunks
        rng = np.random.default_rng([_STREAM, self._seed, number])
        rows = torch.from_numpy(rng.integers(len(chunks.seen), size=config.batch))
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(int(rng.integers(2**62)))
            proposed, likely = self.policy.propose(chunks.seen[rows], config.noise)
        away = (proposed - chunks.actions[rows][:, None]).abs().mean(dim=(2, 3))
        nearest = away.detach().argmin(dim=1, keepdim=True)
        guess = nn.functional.cross_entropy(likely, nearest[:, 0])
        follow = (1.0 - _OTHERS) * away.gather(1, nearest).mean() + _OTHERS * away.mean()
        loss = follow + _LIKELY * guess
        self._adam.param_groups[0]["lr"] = config.lr * (1.0 - (number - 1) / config.updates)
        self._adam.zero_grad()
        loss.backward()
        self._adam.step()
        return float(loss.detach())


def ensembled(chunks: Sequence[np.ndarray], decay: float) -> np.ndarray:
    """The action (A,) now, of the chunks (K, A) that were predicted so far, oldest first.

    Chunks that end before now say nothing. The weight of the i-th that speaks is exp(-decay i).
    Those that are outvoted on holding, an action's last number, are left out: between going down
    and rising with what was taken there is nothing, and a tip that did the mean of both hovered.
    """
    reach = len(chunks[-1])
    last = list(chunks[-reach:])
    said = np.array([chunk[len(last) - 1 - k] for k, chunk in enumerate(last)])
    weights = np.exp(-decay * np.arange(len(said)))
    holds = said[:, -1] > 0.0
    weights *= holds == (weights @ said[:, -1] > 0.0)
    return np.asarray((weights[:, None] * said).sum(axis=0) / weights.sum())


@dataclass(frozen=True)
class PlayedClone:
    """What came of an episode.

    Attributes:
        solved: as the environment counts it, and by no guard's leave
        steps: control steps
    """

    solved: bool
    score: float
    steps: int
    ended: str


def play_clone(
    how: ControlSetup,
    policy: ChunkPolicy,
    seeds: Sequence[int],
    *,
    decay: float = CloningConfig.decay,
) -> dict[int, PlayedClone]:
    """Let a policy play the episodes of seeds; what came of them, by seed."""
    control, said = control_worlds(how), dict[int, list[np.ndarray]]()

    def act(runs: Mapping[int, ControlEpisode]) -> dict[int, np.ndarray | None]:
        seen = np.stack([observed(control, slot, run) for slot, run in runs.items()])
        with torch.no_grad():
            chunks = policy(torch.from_numpy(seen)).numpy()
        actions: dict[int, np.ndarray | None] = {}
        for (slot, run), chunk in zip(runs.items(), chunks, strict=True):
            said.setdefault(run.seed, []).append(chunk)
            action = np.clip(ensembled(said[run.seed], decay), -1.0, 1.0)
            actions[slot] = action.astype(np.float32)
        return actions

    return {
        run.seed: PlayedClone(
            run.ended == SOLVED,
            run.rows[-1].score if run.rows else 0.0,
            len(run.actions),
            run.ended or "",
        )
        for _, run in play_control_episodes(control, seeds, start=lambda runs: None, act=act)
    }
