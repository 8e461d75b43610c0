"""What a cloned policy is told: the same wherever on the table, and what it is for."""

from __future__ import annotations

import math

import pytest
import torch

from learning.control.features import StateSizes, relative_features

BLOCK, CABLE = StateSizes(0, 1, (3,)), StateSizes(4, 0, (4, 2))
OWN = 6
"""Features of the tip alone: place, sine and cosine of its yaw, and what it holds."""


def block(tip: list[float], place: list[float], turn: float, goal: list[float]) -> torch.Tensor:
    body = [*place, 0.0, 0.0, math.sin(turn / 2), math.cos(turn / 2)]
    return torch.tensor([[*tip, 1.0, *body, *goal, 0.3]], dtype=torch.float64)


def test_a_move_of_everything_changes_only_where_the_tip_is() -> None:
    here = block([0.1, 0.2, 0.05, 0.4], [0.15, 0.18, 0.02], 0.7, [0.3, -0.1, 1.2])
    there = block([0.5, -0.1, 0.05, 0.4], [0.55, -0.12, 0.02], 0.7, [0.7, -0.4, 1.2])
    one, other = (relative_features(seen, BLOCK) for seen in (here, there))
    assert torch.allclose(one[:, 2:], other[:, 2:], atol=1e-12)
    assert not torch.allclose(one[:, :2], other[:, :2])


def test_a_block_at_its_goal_leaves_nothing_to_do() -> None:
    seen = block([0.12, 0.2, 0.05, 0.0], [0.15, 0.18, 0.02], 0.7, [0.15, 0.18, 0.7])
    away_x, away_y, cos, sin, tip_x, tip_y = relative_features(seen, BLOCK)[0, -6:].tolist()
    assert (away_x, away_y, sin, tip_x, tip_y) == pytest.approx((0.0,) * 5, abs=1e-7)
    assert cos == pytest.approx(1.0)


def test_the_tip_is_told_where_to_carry_what_it_holds() -> None:
    """A block turned by a right angle about its goal takes the tip with it."""
    seen = block([0.2, 0.1, 0.05, 0.0], [0.1, 0.1, 0.02], 0.0, [0.1, 0.1, math.pi / 2])
    move = relative_features(seen, BLOCK)[0, -2:].tolist()
    assert move == pytest.approx((-0.1, 0.1), abs=1e-7)


def test_beads_are_told_how_far_their_targets_are_and_velocities_are_not_told() -> None:
    generator = torch.Generator().manual_seed(0)
    seen = torch.randn(2, CABLE.numbers, generator=generator)
    quick = seen.clone()
    quick[:, 5 + 12 : 5 + 24] += 1.0
    quick[:, -1] += 1.0
    told = relative_features(seen, CABLE)
    assert torch.equal(relative_features(quick, CABLE), told)
    beads = seen[:, 5 : 5 + 12].reshape(2, 4, 3)[..., :2] + seen[:, None, :2]
    targets = seen[:, -9:-1].reshape(2, 4, 2)
    assert torch.allclose(told[:, -8:], (targets - beads).flatten(1), atol=1e-6)


@pytest.mark.parametrize("sizes", [BLOCK, CABLE, StateSizes(3, 2, ()), StateSizes(5, 0, (1, 3))])
def test_every_kind_of_state_has_finite_features(sizes: StateSizes) -> None:
    seen = torch.randn(7, sizes.numbers, generator=torch.Generator().manual_seed(1))
    told = relative_features(seen, sizes)
    assert told.shape[0] == 7 and told.isfinite().all() and told.shape[1] > OWN
