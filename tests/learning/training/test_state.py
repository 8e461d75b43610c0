"""Weights in training: which take longer steps, and which are held."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from learning.models.gt_state import GtState, GtState2Step, GtStateConfig
from learning.runs.folder import RunFolder
from learning.training.schedules import Schedule
from learning.training.state import Trained

STATES = Schedule(steps=60, batch=16, lr=3e-3, warmup=2, decay=True, ema=0.9, snapshots=2)


@pytest.mark.parametrize("name", ["gt-mlp", "gt-mlp-2step"])
def test_only_a_place_network_takes_longer_steps(name: str, tmp_path: Path) -> None:
    moves = []
    for place_lr in (1.0, 5.0):
        cls = GtState if name == "gt-mlp" else GtState2Step
        agent = cls(3, GtStateConfig(), seed=0)
        before = {key: each.detach().clone() for key, each in agent.named_parameters()}
        plan = replace(STATES, place_lr=place_lr)
        trained = Trained(agent, plan, RunFolder(tmp_path), "key")
        for number in (1, 2):  # the same gradient, so that the second step is as long as the first
            trained.step(number, torch.linspace(-1, 1, sum(map(torch.numel, before.values()))))
        moves.append({key: each.detach() - before[key] for key, each in agent.named_parameters()})
    for key, move in moves[0].items():
        factor = 5.0 if key.startswith("place.") else 1.0
        assert torch.allclose(moves[1][key], factor * move, atol=1e-7, rtol=1e-5), key
    assert any(key.startswith("place.") for key in moves[0]) == (name == "gt-mlp-2step")


def mixing(parameters: Mapping[str, torch.Tensor]) -> list[torch.Tensor]:
    """What gives Gaussians their weights."""
    return [each for name, each in parameters.items() if ".mixing." in name]


@pytest.mark.parametrize("cls", [GtState, GtState2Step])
def test_gaussians_weigh_the_same_at_first_and_nothing_else_is_held(
    cls: type[GtState | GtState2Step], tmp_path: Path
) -> None:
    after = []
    for even in (0.0, 0.5):
        agent = cls(3, GtStateConfig(), seed=0)
        plan = replace(STATES, steps=4, snapshots=1, even=even, place_lr=5.0)
        trained = Trained(agent, plan, RunFolder(tmp_path), "key")
        gradient = torch.linspace(-1, 1, sum(each.numel() for each in agent.parameters()))
        held = [not any(bool(each.any()) for each in mixing(trained.averaged()))]
        for number in (1, 2, 3):
            trained.step(number, gradient)
            held.append(
                not any(bool(each.any()) for each in mixing(dict(agent.named_parameters())))
            )
        assert held == ([True, True, True, False] if even else [False] * 4)
        after.append({key: each.detach().clone() for key, each in agent.named_parameters()})
    for key, each in after[0].items():
        assert torch.equal(each, after[1][key]) == (".mixing." not in key), key
