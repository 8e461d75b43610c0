"""Parity with the original's TensorFlow modules: forward, loss, and one training step.

tests/data/README.md says what the file holds. Errors are relative to the largest logit.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn
from torch.nn import functional

from learning.models.adam import KerasAdam
from learning.models.attention import Attention
from learning.models.images import image_tensor
from learning.models.resnet import ResNet43
from learning.models.transport import Transport

pytestmark = pytest.mark.usefixtures("one_torch_thread")

GOLDEN = Path(__file__).parent / "data" / "transporter_tf.npz"
MODULES = {
    "attention": lambda g: Attention(exact=True, generator=g),
    "attention_goal": lambda g: Attention(pictures=2, exact=True, generator=g),
    "transport_crop_after": lambda g: Transport(exact=True, generator=g),
    "transport_crop_before": lambda g: Transport(exact=True, crop_before_query=True, generator=g),
    "transport_goal_stack": lambda g: Transport(
        pictures=2, exact=True, crop_before_query=True, generator=g
    ),
    "transport_goal_split": lambda g: Transport(
        pictures=2, goal_split=True, exact=True, generator=g
    ),
}


@pytest.fixture(scope="module")
def golden() -> dict[str, np.ndarray]:
    with np.load(GOLDEN) as data:
        return dict(data)


def load_weights(network: ResNet43, *, seed: int, index: int) -> None:
    """The weights that the file's outputs were made with."""
    for k, convolution in enumerate(network.convolutions()):
        rng = np.random.default_rng([seed, index, k])
        out, into, height, width = convolution.weight.shape
        spread = math.sqrt(2 / (height * width * (into + out)))
        kernel = rng.standard_normal((height, width, into, out)) * spread
        bias = rng.standard_normal(out) * 0.05
        with torch.no_grad():
            convolution.weight.copy_(torch.from_numpy(kernel.transpose(3, 2, 0, 1)))
            convolution.bias.copy_(torch.from_numpy(bias))


def relative(ours: np.ndarray, theirs: np.ndarray) -> float:
    return float(np.abs(ours - theirs).max() / np.abs(theirs).max())


@pytest.mark.parametrize("name", MODULES)
def test_parity(name: str, golden: dict[str, np.ndarray]) -> None:
    module: nn.Module = MODULES[name](torch.Generator())
    networks = [each for each in module.modules() if isinstance(each, ResNet43)]
    first = 0 if name.startswith("attention") else 1
    for index, network in enumerate(networks, start=first):
        load_weights(network, seed=int(golden["seed"]), index=index)
    colors = np.split(golden[f"{name}_color"], golden[f"{name}_color"].shape[2] // 3, axis=2)
    heights = golden[f"{name}_height"].transpose(2, 0, 1)
    image = torch.cat([image_tensor(*each) for each in zip(colors, heights, strict=True)])[None]
    pick, place = golden["pick"], golden["place"]
    n = int(golden["n_rotations"])

    def logits() -> torch.Tensor:
        """(H, W) or (H, W, R), as in the file."""
        if name.startswith("attention"):
            heat: torch.Tensor = module(image)[0]
            return heat
        maps = module(image, torch.from_numpy(pick)[None], n_rotations=n)
        return maps[0].permute(1, 2, 0)

    if name.startswith("attention"):
        label = np.ravel_multi_index(tuple(pick), (320, 160))
    else:
        rotation = round(float(golden["theta"]) / (2 * math.pi / n)) % n
        label = np.ravel_multi_index((*place, rotation), (320, 160, n))

    before = logits()
    loss = functional.cross_entropy(before.reshape(1, -1), torch.tensor([int(label)]))
    assert relative(before.detach().numpy(), golden[f"{name}_logits"]) < 1e-5
    assert float(loss.detach()) == pytest.approx(float(golden[f"{name}_loss"]), rel=1e-5)

    optimiser = KerasAdam(module.parameters(), lr=1e-4)
    loss.backward()
    optimiser.step()
    with torch.no_grad():
        after = logits()[::4, ::4].numpy()
    assert relative(after, golden[f"{name}_logits_after_step"]) < 5e-4
