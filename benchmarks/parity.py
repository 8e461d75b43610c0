"""How far the agents' networks are from the original's TensorFlow modules, and their parameters.

    python benchmarks/parity.py

tests/data/README.md says what the golden file holds: for each module logits, loss, and logits after
one training step, from weights that can be built again. Errors of logits are relative to the
largest one, those of losses relative. Some minutes on one core.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from learning.models.adam import KerasAdam
from learning.models.attention import Attention
from learning.models.images import image_tensor
from learning.models.resnet import ResNet43
from learning.models.transport import Transport

GOLDEN = Path(__file__).resolve().parent.parent / "tests" / "data" / "transporter_tf.npz"
MODULES: dict[str, Callable[[torch.Generator], Attention | Transport]] = {
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


class Errors(NamedTuple):
    """Relative errors: logits, loss, logits after one training step if there was one."""

    logits: float
    loss: float
    after_step: float | None


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.parse_args()
    torch.set_num_threads(1)
    golden = read_golden()
    print("| module | logits | loss | logits after a step |\n|---|---|---|---|")
    for name in MODULES:
        errors = measure(name, golden)
        print(f"| {name} | " + " | ".join(f"{each:.1e}" for each in errors) + " |", flush=True)
    print("\n| network | parameters |\n|---|---|")
    for name in ("attention", "transport_crop_after", "transport_goal_split"):
        count = sum(each.numel() for each in MODULES[name](torch.Generator()).parameters())
        print(f"| {name} | {count:,} |")


def read_golden() -> dict[str, np.ndarray]:
    """The original's inputs and outputs by name."""
    with np.load(GOLDEN) as data:
        return dict(data)


def measure(name: str, golden: dict[str, np.ndarray], *, step: bool = True) -> Errors:
    """Errors of a module; the training step takes four fifths of the time."""
    module: nn.Module = MODULES[name](torch.Generator())
    networks = [each for each in module.modules() if isinstance(each, ResNet43)]
    first = 0 if name.startswith("attention") else 1
    for index, network in enumerate(networks, start=first):
        _load_weights(network, seed=int(golden["seed"]), index=index)
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

    with torch.set_grad_enabled(step):
        before = logits()
        loss = functional.cross_entropy(before.reshape(1, -1), torch.tensor([int(label)]))
    after_step = None
    if step:
        optimiser = KerasAdam(module.parameters(), lr=1e-4)
        loss.backward()
        optimiser.step()
        with torch.no_grad():
            after = logits()[::4, ::4].numpy()
        after_step = _relative(after, golden[f"{name}_logits_after_step"])
    return Errors(
        _relative(before.detach().numpy(), golden[f"{name}_logits"]),
        _relative(loss.detach().numpy(), golden[f"{name}_loss"]),
        after_step,
    )


def _load_weights(network: ResNet43, *, seed: int, index: int) -> None:
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


def _relative(ours: np.ndarray, theirs: np.ndarray) -> float:
    return float(np.abs(ours - theirs).max() / np.abs(theirs).max())


if __name__ == "__main__":
    main()
