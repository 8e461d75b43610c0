"""Networks whose maps turn with the picture: exactly, whatever the weights."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from torch import Tensor

from learning.models.images import image_tensor
from learning.models.quarter_turns import Field, QuarterTurnConvolution
from learning.models.resnet import NetworkConfig, ResNet43
from learning.models.transporter import PRESETS, GoalSplit, GoalStack, Transporter
from warp_deform.errors import InputError


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def turn(x: Tensor, quarters: int) -> Tensor:
    return x.rot90(quarters, dims=(-2, -1))


def turned_field(x: Tensor, quarters: int, field: Field) -> Tensor:
    """A plain field turns; the maps of a regular one change places as well."""
    if field == "plain":
        return turn(x, quarters)
    fours = x.unflatten(1, (-1, 4)).roll(quarters, dims=2).flatten(1, 2)
    return turn(fours, quarters)


@pytest.mark.parametrize("quarters", [1, 2, 3])
@pytest.mark.parametrize(
    ("reads", "gives", "size"),
    [
        ("regular", "regular", 3),
        ("regular", "regular", 1),
        ("plain", "regular", 3),
        ("regular", "plain", 1),
    ],
)
def test_turned_maps_give_turned_maps(reads: Field, gives: Field, size: int, quarters: int) -> None:
    convolution = QuarterTurnConvolution(8, 12, size, reads=reads, gives=gives)
    convolution.draw(generator())
    torch.nn.init.uniform_(convolution.bias, generator=generator(1))
    x = torch.randn(2, 8, 10, 7, generator=generator(2))
    expected = turned_field(convolution(x), quarters, gives)
    actual = convolution(turned_field(x, quarters, reads))
    torch.testing.assert_close(actual, expected, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(("pictures", "subpixels"), [(1, 1), (2, 2), (None, 1)])
def test_gradients_come_back_to_the_weights_they_are_of(
    pictures: int | None, subpixels: int
) -> None:
    """A kernel is linear in its weights: <kernel(w), g> = <w, gradient>, for any w and g."""
    if pictures is None:
        convolution = QuarterTurnConvolution(8, 12, 3)
    else:
        seen = 6 * pictures * subpixels**2
        convolution = QuarterTurnConvolution(
            seen, 12, 3, reads="plain", pictures=pictures, subpixels=subpixels
        )
    convolution.draw(generator())
    kernel = convolution.kernel()
    g = torch.randn(kernel.shape, generator=generator(3))
    (gradient,) = torch.autograd.grad(kernel, convolution.weight, g)
    assert kernel.shape == (12, convolution.channels[0], 3, 3)
    for seed in range(4):
        torch.nn.init.normal_(convolution.weight, generator=generator(seed))
        ahead, back = (convolution.kernel() * g).sum(), (convolution.weight * gradient).sum()
        torch.testing.assert_close(ahead, back, atol=1e-4, rtol=1e-5)


def test_a_turned_kernel_holds_the_learnt_weights() -> None:
    """Only one map in four is learnt, and its kernel is the first of each four."""
    convolution = QuarterTurnConvolution(8, 12, 3)
    convolution.draw(generator())
    assert convolution.weight.shape == (3, 2, 4, 3, 3)
    kernel = convolution.kernel()
    assert kernel.shape == (12, 8, 3, 3)
    assert torch.equal(kernel[::4], convolution.weight.flatten(1, 2))
    for own, next_ in zip(kernel[::4], kernel[1::4], strict=True):
        assert torch.equal(own.flatten().sort().values, next_.flatten().sort().values)
        assert not torch.equal(own, next_)


@pytest.mark.parametrize("fine", [False, True])
@pytest.mark.parametrize("agent", [Transporter, GoalSplit, GoalStack])
def test_agents_turn_with_the_camera_s_picture(agent: type[Transporter], fine: bool) -> None:
    """Pick and place maps of a turned picture are the turned maps, at the camera's resolution."""
    config = dataclasses.replace(PRESETS["fast"], fine=fine, crop=16, width=0.125)
    network, rng, side = agent(config, seed=0), np.random.default_rng(0), 24
    pictures = [
        (
            rng.integers(0, 256, (2 * side, 2 * side, 3), dtype=np.uint8),
            rng.uniform(0, 0.02, (2 * side, 2 * side)).astype(np.float32),
        )
        for _ in range(network.pictures)
    ]

    def image(quarters: int) -> Tensor:
        turned = [[np.rot90(each, quarters) for each in picture] for picture in pictures]
        return torch.cat([image_tensor(*each, scale=2, fine=fine) for each in turned])[None]

    pick, turned_pick = torch.tensor([[9, 14]]), torch.tensor([[side - 1 - 14, 9]])
    with torch.no_grad():
        for still, turned in (
            (network.attention(image(0)), network.attention(image(1))),
            (network.transport(image(0), pick), network.transport(image(1), turned_pick)),
        ):
            near = 1e-4 * float(still.std())
            torch.testing.assert_close(turned, turn(still, 1), atol=near, rtol=1e-4)
            assert not torch.allclose(still, turn(still, 1), atol=100 * near)


@pytest.mark.parametrize("subpixels", [1, 2])
def test_networks_turn_with_every_pixel_of_the_picture(subpixels: int) -> None:
    config = NetworkConfig(width=0.125, skips=True, equivariant=True, subpixels=subpixels)
    network = ResNet43(3, pictures=2, config=config, marks=1, generator=generator())
    fine = torch.randn(1, 2, 6, 24 * subpixels, 16 * subpixels, generator=generator(1))

    def channels(x: Tensor) -> Tensor:
        rows, columns = x.shape[-2] // subpixels, x.shape[-1] // subpixels
        blocks = x.reshape(1, 2, 6, rows, subpixels, columns, subpixels)
        return blocks.permute(0, 1, 4, 6, 2, 3, 5).reshape(1, -1, rows, columns)

    mark = torch.rand(1, 1, 24, 16, generator=generator(2))
    with torch.no_grad():
        still = network(channels(fine), mark)
        for quarters in (1, 2, 3):
            actual = network(channels(turn(fine, quarters)), turn(mark, quarters))
            torch.testing.assert_close(actual, turn(still, quarters), atol=2e-5, rtol=1e-4)
    assert not torch.allclose(still, turn(still, 2), atol=1e-3)


def test_a_quarter_of_the_weights_is_learnt() -> None:
    plain, turning = (
        ResNet43(1, config=NetworkConfig(width=0.25, equivariant=each), generator=generator())
        for each in (False, True)
    )
    learnt, all_ = (sum(p.numel() for p in each.parameters()) for each in (turning, plain))
    assert learnt == pytest.approx(all_ / 4, rel=0.02)
    assert len(turning.convolutions()) == len(plain.convolutions()) == 57


def test_what_makes_up_no_field_is_refused() -> None:
    with pytest.raises(InputError, match="fours"):
        QuarterTurnConvolution(6, 8, 3)
    with pytest.raises(InputError, match="images"):
        QuarterTurnConvolution(12, 8, 3, reads="plain", pictures=2, subpixels=4)
    with pytest.raises(InputError, match="side 1"):
        QuarterTurnConvolution(8, 3, 3, gives="plain")
