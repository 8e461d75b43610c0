"""Networks computed together say what the plain ones say, and learn alike from the same weights."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fixtures.labelled_images import labelled_images
from torch import Tensor

from learning.models.adam import KerasAdam
from learning.models.batch import Batch
from learning.models.grouped import GroupedNetworks, Window
from learning.models.precision import has_bfloat16_tiles
from learning.models.transporter import PRESETS, GoalSplit, GoalStack, Transporter
from learning.training.config import TrainConfig
from learning.training.train import _bfloat16

SMALL = replace(PRESETS["fast"], scale=4, width=0.125, crop=16)
PLAIN = replace(SMALL, equivariant=False, skips=False, fine=False, mark_pick=False)
PICKS = torch.tensor([[0, 39], [41, 18], [79, 2]])
"""Two of them in corners, where windows end with the picture."""


def batch(agent: Transporter) -> Batch:
    return labelled_images(agent, PICKS)


def plainly(agent: Transporter) -> Transporter:
    """The same agent, network by network."""
    plain = copy.deepcopy(agent)
    plain.pick_place = None
    return plain


def gradient(agent: Transporter, labelled: Batch) -> Tensor:
    agent.zero_grad()
    agent(labelled).total().backward()
    parts = [each.grad for each in agent.parameters()]
    assert all(part is not None for part in parts)
    return torch.cat([part.double().flatten() for part in parts if part is not None])


def error(found: Tensor, exact: Tensor) -> float:
    return float((found - exact).norm() / exact.norm())


@pytest.mark.parametrize(
    ("agent_class", "config"),
    [(Transporter, SMALL), (GoalSplit, replace(SMALL, n_rotations_train=6)), (GoalStack, PLAIN)],
)
def test_gradients_are_those_of_double_precision(
    agent_class: type[Transporter], config: Any
) -> None:
    agent = agent_class(config, seed=0)
    assert agent.pick_place is not None
    exact = plainly(agent).double()
    labelled = batch(agent)
    expected = gradient(exact, labelled._replace(image=labelled.image.double()))
    ours, plain = (gradient(each, labelled) for each in (agent, plainly(agent)))
    assert error(ours, expected) < max(3 * error(plain, expected), 1e-5)


@pytest.mark.parametrize(("agent_class", "config"), [(Transporter, PLAIN), (GoalSplit, SMALL)])
def test_bfloat16_gradients_are_near_those_of_double_precision(
    agent_class: type[Transporter], config: Any
) -> None:
    """Networks side by side, each in its channels: one in another's place would be far off."""
    agent = agent_class(replace(config, bfloat16=True), seed=0)
    exact = plainly(agent_class(config, seed=0)).double()
    labelled = batch(agent)
    expected = gradient(exact, labelled._replace(image=labelled.image.double()))
    ours = gradient(agent, labelled)
    assert 1e-4 < error(ours, expected) < 0.2
    bounds = np.cumsum([0, *(each.numel() for each in agent.parameters())])
    for first, end in zip(bounds[::20], bounds[20::20], strict=False):
        part = slice(int(first), int(end))
        assert error(ours[part], expected[part]) < 0.5


def test_bfloat16_learns_as_float32_does() -> None:
    ends = []
    for half in (False, True):
        agent = Transporter(replace(SMALL, bfloat16=half), seed=0)
        labelled = Batch(*(each[:1] for each in batch(agent)))  # one picture does
        optimiser, losses = KerasAdam(agent.parameters(), lr=1e-3), []
        for _ in range(6):
            optimiser.zero_grad()
            loss = agent(labelled).attention
            loss.backward()
            optimiser.step()
            losses.append(float(loss.detach()))
        ends.append((losses[0], losses[-1]))
    (before, single), (_, half_precise) = ends
    assert single < 0.97 * before and half_precise < 0.97 * before
    assert abs(half_precise - single) < 0.3 * (before - single)


@pytest.mark.parametrize(
    ("agent_class", "config"),
    [(Transporter, replace(SMALL, n_rotations_eval=4)), (GoalSplit, SMALL)],
)
def test_acting_chooses_as_before_and_sees_a_picture_once(
    agent_class: type[Transporter], config: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    agent = agent_class(replace(config, gain=1e-3), seed=3)  # unsure places: all picks are weighed
    images = batch(agent).image
    avoid = torch.zeros(len(images), *config.shape, dtype=torch.bool)
    avoid[:, 10:30] = True
    ran: list[tuple[str, ...]] = []
    body = GroupedNetworks.body

    def counted(self: GroupedNetworks, names: Sequence[str], *args: Any) -> Any:
        ran.append(tuple(names))
        return body(self, names, *args)

    expected = plainly(agent).act(images, avoid=avoid)
    monkeypatch.setattr(GroupedNetworks, "body", counted)
    chosen = agent.act(images, avoid=avoid)
    for ours, theirs in zip(chosen, expected, strict=True):
        assert np.array_equal(ours, theirs)
    assert ran.count(("attention", "query")) == len(images)
    per_pick = [each for each in ran if each != ("attention", "query")]
    assert len(per_pick) > 2 * len(images), "several picks were tried"
    assert set(per_pick) == {("key", "goal") if agent.pictures == 2 else ("key",)}


def test_weights_that_were_read_or_moved_are_the_ones_in_use() -> None:
    """Nothing of the weights is kept from one call to the next."""
    agent, other = (Transporter(SMALL, seed=seed) for seed in (0, 1))
    labelled = batch(agent)
    before, wanted = (float(each(labelled).total().detach()) for each in (agent, other))
    agent.load_state_dict(other.state_dict())
    assert float(agent(labelled).total().detach()) == wanted != before
    swapped = torch.func.functional_call(
        other, {k: 0 * v for k, v in other.named_parameters()}, (labelled,)
    )
    assert float(swapped.attention.detach()) == pytest.approx(np.log(80 * 40), rel=1e-6)


def test_two_steps_from_the_same_weights_have_the_same_bits() -> None:
    first, again = (Transporter(SMALL, seed=0) for _ in range(2))
    assert torch.equal(gradient(first, batch(first)), gradient(again, batch(again)))


@pytest.mark.parametrize("reach", [8, 12])
def test_windows_hold_what_crops_reach_and_lie_within_the_picture(reach: int) -> None:
    shape = (80, 40)
    points = torch.cartesian_prod(torch.arange(80), torch.arange(40))
    window = Window.around(points, reach=reach, shape=shape)
    starts = torch.tensor(window.starts)
    for axis, (side, extent) in enumerate(zip(shape, window.size, strict=True)):
        first = starts[:, axis]
        assert extent % 2 == 0 and not (first % 2).any()
        assert int(first.min()) >= 0 and int(first.max()) + extent <= side
        low, high = points[:, axis] - reach, points[:, axis] + reach
        # three pixels more, or the picture's own border
        assert ((first <= low - 3) | (first == 0)).all()
        assert ((first + extent >= high + 4) | (first + extent == side)).all()


@pytest.mark.parametrize(
    ("units", "changes", "expected"),
    [
        ("avx512_bf16", {}, False),
        ("amx_bf16", {}, True),
        ("avx512_vnni", {}, False),
        ("amx_bf16", {"precision": "float32"}, False),
        ("avx2", {"precision": "bfloat16"}, True),
        ("amx_bf16", {"preset": "paper"}, False),
        ("amx_bf16", {"exact": True}, False),
        ("amx_bf16", {"device": "cuda"}, False),
    ],
)
def test_auto_takes_bfloat16_where_the_processor_has_tiles_of_it(
    units: str, changes: dict[str, Any], expected: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {units: True})
    assert has_bfloat16_tiles() == (units == "amx_bf16")
    settings = {"preset": "fast", "task": "cable-ring", "agent": "transporter"} | changes
    config = TrainConfig(data=Path("none"), out=Path("none"), **settings)
    assert _bfloat16(config) is expected
