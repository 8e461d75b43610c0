"""What the networks' build promises: a moved scene moves what they say, a turned one turns it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from learning.models.attention import Attention
from learning.models.correlation import correlate_direct, correlate_fft
from learning.models.crops import rotated_crops
from learning.models.resnet import NetworkConfig
from learning.models.transport import Transport

SIDE = 256
REACH = 80
"""An output depends on fewer pixels to either side; see `resnet.receptive_span`."""
CROP = 16
NARROW = NetworkConfig(width=0.125)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def scene(pictures: int, seed: int = 1) -> Tensor:
    """A random raw image (1, 4 k, SIDE, SIDE), blocks of 4 pixels so that it has some structure."""
    blocks = torch.rand(1, 4 * pictures, SIDE // 4, SIDE // 4, generator=generator(seed))
    scales = torch.tensor([255.0, 255, 255, 0.05] * pictures)[None, :, None, None]
    return torch.nn.functional.interpolate(blocks * scales, scale_factor=4.0)


def inside(shift: tuple[int, int], margin: int) -> tuple[slice, slice]:
    """Pixels whose surroundings were and are within the picture after a shift."""
    return tuple(  # type: ignore[return-value]
        slice(margin + max(0, s), SIDE - margin + min(0, s)) for s in shift
    )


def gap(actual: Tensor, expected: Tensor) -> float:
    """Greatest difference, relative to how much the expected values vary."""
    assert expected.numel() > 200
    return float((actual - expected).abs().max() / expected.std())


@pytest.mark.parametrize("pictures", [1, 2])
@pytest.mark.parametrize("shift", [(8, 0), (0, -16), (-24, 8)])
def test_attention_moves_with_the_scene(pictures: int, shift: tuple[int, int]) -> None:
    network = Attention(pictures=pictures, config=NARROW, generator=generator())
    image = scene(pictures)
    with torch.no_grad():
        still = network(image).roll(shift, dims=(-2, -1))[0]
        moved = network(image.roll(shift, dims=(-2, -1)))[0]
    where = inside(shift, REACH)
    assert gap(moved[where], still[where]) < 1e-3
    assert gap(moved[where], network(image)[0].detach()[where]) > 1.0, "something did move"


TRANSPORTS: dict[str, Callable[[], nn.Module]] = {
    "transporter": lambda: Transport(crop=CROP, config=NARROW, generator=generator()),
    "crop before": lambda: Transport(
        crop=CROP, config=NARROW, crop_before_query=True, generator=generator()
    ),
    "marked": lambda: Transport(
        crop=CROP, config=NARROW, mark_pick=True, pad_features=True, generator=generator()
    ),
    "goal-split": lambda: Transport(
        pictures=2,
        goal_split=True,
        crop=CROP,
        config=dataclasses.replace(NARROW, equivariant=True),
        goal_bias=1.0,
        mark_pick=True,
        generator=generator(),
    ),
}


@pytest.mark.parametrize("name", TRANSPORTS)
@pytest.mark.parametrize("shift", [(8, -16), (-16, 0)])
def test_transport_moves_with_the_scene_and_the_pick(name: str, shift: tuple[int, int]) -> None:
    network = TRANSPORTS[name]()
    image = scene(2 if name == "goal-split" else 1)
    pick = torch.tensor([[120, 133]])
    # Quarter turns: at 120 degrees source pixels are ties, which rounding decides by the place.
    with torch.no_grad():
        still = network(image, pick, n_rotations=4)[0]
        rolled = image.roll(shift, dims=(-2, -1))
        moved = network(rolled, pick + torch.tensor(shift), n_rotations=4)[0]
    rows, columns = inside(shift, REACH + CROP // 2)
    expected = still.roll(shift, dims=(-2, -1))[:, rows, columns]
    assert gap(moved[:, rows, columns], expected) < 1e-3
    assert gap(moved[:, rows, columns], still[:, rows, columns]) > 1.0


@pytest.mark.parametrize("quarter", [1, 2, 3])
def test_crops_of_a_turned_map_are_the_crops_of_other_rotations(quarter: int) -> None:
    """A crop has no middle pixel: its first row and column have no partner on the other side."""
    map_ = torch.rand(1, 3, 33, 33, generator=generator())
    centre = torch.tensor([[16, 16]])
    still, turned = (
        rotated_crops(each, centre, size=CROP, n_rotations=4)[..., 1:, 1:]
        for each in (map_, map_.rot90(quarter, dims=(-2, -1)))
    )
    assert torch.equal(turned, still.roll(-quarter, dims=1))
    assert torch.equal(turned, still.rot90(quarter, dims=(-2, -1)))


@pytest.mark.parametrize("correlate", [correlate_direct, correlate_fft])
def test_correlation_turns_with_the_scene(correlate: Callable[[Tensor, Tensor], Tensor]) -> None:
    """What lies around the pick is turned with the scene: the same rotation fits at turned places.

    Where the scene turns and the picked object does not, the rotation that fits is another one.
    """
    size, side = CROP, 41
    centre = torch.tensor([[side // 2, side // 2]])
    key = torch.rand(1, 3, side, side, generator=generator(2))
    query = torch.zeros_like(key)
    near = slice(side // 2 - size // 2 + 1, side // 2 + size // 2)
    query[..., near, near] = torch.rand(1, 3, size - 1, size - 1, generator=generator(3))

    def places(scene: Tensor, object_: Tensor) -> np.ndarray:
        """Logits (4, H, W) of places, an odd number a side about the scene's middle."""
        crops = rotated_crops(object_, centre, size=size, n_rotations=4)
        return correlate(scene, crops)[0, :, : side - size, : side - size].numpy()

    def quarter(x: Tensor) -> Tensor:
        return x.rot90(1, dims=(-2, -1))

    still = places(key, query)
    turned = np.rot90(still, 1, axes=(-2, -1))
    both = places(quarter(key), quarter(query))
    np.testing.assert_allclose(both, turned, atol=1e-5)
    alone = places(quarter(key), query)
    np.testing.assert_allclose(alone, np.roll(turned, 1, axis=0), atol=1e-5)
