"""Whole Transporters: what they refuse, how labels become actions, and whether they learn."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from learning.models.adam import KerasAdam
from learning.models.transporter import (
    PRESETS,
    Batch,
    GoalSplit,
    GoalStack,
    Transporter,
    TransporterConfig,
)
from warp_deform.errors import InputError

AGENTS = (Transporter, GoalSplit, GoalStack)
TINY = TransporterConfig(scale=4, width=0.125, crop=16, n_rotations_train=4, n_rotations_eval=4)


@pytest.mark.parametrize("agent_class", AGENTS)
def test_fast_and_exact_correlation_agree(agent_class: type[Transporter]) -> None:
    image = (
        torch.rand(1, 4 * agent_class.pictures, 80, 40, generator=torch.Generator().manual_seed(0))
        * 50
    )
    pick = torch.tensor([[70, 5]])
    fast, exact = (
        agent_class(dataclasses.replace(TINY, exact=exact), seed=0).transport(
            image, pick, n_rotations=4
        )
        for exact in (False, True)
    )
    assert (fast - exact).abs().max() < 1e-5 * exact.abs().max()


def batch(agent: Transporter) -> Batch:
    """Two pictures of a red block to pick and, seen in the goal's picture or as a green mark, where
    to place it, a quarter turn round.
    """
    rng = np.random.default_rng(0)
    images = []
    for row, goal_row in ((60, 228), (200, 88)):
        pictures = []
        for at in (row, goal_row)[: agent.pictures]:
            color = rng.integers(60, 90, (320, 160, 3), dtype=np.uint8)
            height = np.zeros((320, 160), np.float32)
            if agent.pictures == 1:
                color[goal_row : goal_row + 16, 100:124] = (40, 255, 40)
            column = 100 if pictures else 40
            block = slice(at, at + 16), slice(column, column + 24)
            color[block], height[block] = (255, 40, 40), 0.03
            pictures.append((color, height))
        images.append(agent.image(*pictures))
    return Batch(
        image=torch.stack(images),
        pick=torch.tensor([[17, 13], [52, 13]]),
        place=torch.tensor([[59, 28], [24, 28]]),
        theta=torch.tensor([-math.pi / 2, -math.pi / 2]),
        lift=torch.tensor([0, 1]),
    )


@pytest.mark.parametrize("agent_class", AGENTS)
def test_agent_learns_its_labels(agent_class: type[Transporter]) -> None:
    config = dataclasses.replace(TINY, lifts=(0.05, 0.3))
    agent = agent_class(config, seed=1)  # from seed 0 losses leap, on some processors at the end
    labelled = batch(agent)
    optimiser = KerasAdam(agent.parameters(), lr=3e-4)
    for _ in range(60):
        losses = agent(labelled)
        optimiser.zero_grad()
        losses.total().backward()
        optimiser.step()
    action = agent.act(labelled.image)
    for name in ("pick", "place"):
        expected = config.to_camera(getattr(labelled, name).numpy())
        assert np.abs(getattr(action, name) - expected).max() <= config.scale
    # theta is pick yaw minus place yaw, and picks have a yaw of 0
    assert action.place_yaw == pytest.approx([math.pi / 2] * 2)
    assert action.lift.tolist() == [0.05, 0.3]


class Peak(torch.nn.Module):
    """Stands in for a network: the same logits whatever it sees."""

    def __init__(self, logits: torch.Tensor) -> None:
        super().__init__()
        self.logits = logits

    def forward(self, image: torch.Tensor, *_: torch.Tensor, **__: int) -> torch.Tensor:
        return self.logits


@pytest.mark.parametrize(
    ("theta", "index", "yaw"),
    [
        (0.0, 0, 0.0),
        (0.7, 0, 0.0),
        (0.9, 1, -math.pi / 2),
        (math.pi, 2, -math.pi),
        (-1.6, 3, math.pi / 2),
        (-6.2, 0, 0.0),
    ],
)
def test_rotation_label_and_its_action(theta: float, index: int, yaw: float) -> None:
    agent = Transporter(TINY, seed=0)
    heat, maps = torch.zeros(1, 80, 40), torch.zeros(1, 4, 80, 40)
    heat[0, 70, 5], maps[0, index, 3, 39] = 5.0, 5.0
    agent.attention, agent.transport = Peak(heat), Peak(maps)
    image = torch.zeros(1, 4, 80, 40)
    losses = agent(
        Batch(
            image,
            torch.tensor([[70, 5]]),
            torch.tensor([[3, 39]]),
            torch.tensor([theta]),
            torch.tensor([0]),
        )
    )
    for loss, n in ((losses.attention, 3200), (losses.transport, 12800)):
        assert float(loss) == pytest.approx(math.log1p((n - 1) / math.exp(5)), rel=1e-5)
    action = agent.act(image)
    assert action.pick.tolist() == [[281.5, 21.5]]
    assert action.place.tolist() == [[13.5, 157.5]]
    assert action.place_yaw == pytest.approx([yaw])
    assert action.lift.tolist() == [0.04]


@pytest.mark.parametrize("agent_class", AGENTS)
def test_losses_share_no_parameter_and_start_uninformed(agent_class: type[Transporter]) -> None:
    agent = agent_class(dataclasses.replace(TINY, lifts=(0.05, 0.3)), seed=0)
    losses = agent(batch(agent))
    for name, loss in losses._asdict().items():
        agent.zero_grad()
        loss.backward(retain_graph=True)
        reached = {key.split(".")[0] for key, p in agent.named_parameters() if p.grad is not None}
        assert reached == {name}
    assert float(losses.lift.detach()) == pytest.approx(math.log(2), rel=1.0)
    single = agent_class(TINY, seed=0)
    assert single.lift is None
    assert float(single(batch(single)).lift) == 0


@pytest.mark.parametrize("scale", [1, 2, 4])
def test_pixels_survive_the_network_s_grid(scale: int) -> None:
    config = TransporterConfig(scale=scale, crop=16)
    pixels = np.stack(np.mgrid[0:320:7, 0:160:3], axis=-1)
    network = config.to_network(pixels)
    assert network.max(axis=(0, 1)).tolist() < list(config.shape)
    assert np.abs(config.to_camera(network) - pixels).max() <= (scale - 1) / 2
    assert np.array_equal(config.to_network(np.rint(config.to_camera(network))), network)


@pytest.mark.parametrize(
    "wrong",
    [{"scale": 3}, {"scale": 0}, {"crop": 20}, {"crop": 0}, {"n_rotations_eval": 0}, {"lifts": ()}],
)
def test_wrong_configuration_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(InputError, match=next(iter(wrong))):
        dataclasses.replace(PRESETS["fast"], **wrong)


def test_wrong_input_is_refused() -> None:
    agent = GoalSplit(TINY, seed=0)
    labelled = batch(agent)
    with pytest.raises(InputError, match="goal-split: 1 goal"):
        agent.image((np.zeros((320, 160, 3), np.uint8), np.zeros((320, 160), np.float32)))
    with pytest.raises(InputError, match="image"):
        agent.act(labelled.image[:, :4])
    with pytest.raises(InputError, match=r"place: pixel \[80, 3\]"):
        agent(labelled._replace(place=torch.tensor([[0, 0], [80, 3]])))
    with pytest.raises(InputError, match="crop_before_query"):
        GoalSplit(dataclasses.replace(TINY, crop_before_query=True), seed=0)


def test_stack_crops_before_the_query_unless_told_otherwise() -> None:
    assert Transporter(TINY, seed=0).transport.crop_before_query is False
    assert GoalStack(TINY, seed=0).transport.crop_before_query is True
    after = dataclasses.replace(TINY, crop_before_query=False)
    assert GoalStack(after, seed=0).transport.crop_before_query is False
