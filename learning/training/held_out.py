"""Held-out demonstrations: the loss on what is not learnt from says which snapshot to take.

Where nothing can be played, on a robot say, this stands in for validation episodes.

Source: Seita et al., ICRA 2021, section on physical experiments: of 30 demonstrations 24 to learn
from and 6 for validation, the snapshot of the lowest validation loss is used.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from ..data.batches import agent_batch
from ..data.dataset import Demonstrations
from ..policy.policy import Agent

__all__ = ["HeldOut"]


class HeldOut:
    """Every transition of demonstrations that are not learnt from.

    Args:
        agent: whose losses
        data: the demonstrations
    """

    def __init__(self, agent: Agent, data: Demonstrations) -> None:
        self._agent, self._data = agent, data

    @torch.no_grad()
    def loss(self, weights: Mapping[str, Tensor]) -> float:
        """Mean loss over all transitions, as they were recorded, with weights by name."""
        device = next(iter(weights.values())).device
        transitions = [
            (e, t) for e, length in enumerate(self._data.lengths()) for t in range(length)
        ]
        losses = [
            torch.func.functional_call(self._agent, dict(weights), self._inputs(transition, device))
            .total()
            .item()
            for transition in transitions
        ]
        return float(np.mean(losses))

    def _inputs(self, transition: tuple[int, int], device: torch.device) -> tuple[object, ...]:
        rng = np.random.default_rng(0)  # nothing is drawn
        return agent_batch(
            self._data,
            self._agent,
            transitions=[transition],
            rng=rng,
            augment=False,
            device=device,
        )
