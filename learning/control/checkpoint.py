"""What a training by gradients goes on from, as tensors by name: modules and Adam's moments."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from warp_deform.errors import InputError

__all__ = ["put_back", "tensors_of"]


def tensors_of(
    modules: Mapping[str, nn.Module], optimizers: Mapping[str, torch.optim.Adam]
) -> dict[str, Tensor]:
    """Copies of weights and statistics, and of what optimisers remember, by name.

    Before an optimiser's first step it remembers nothing, and nothing is there.
    """
    tensors = {
        f"{name}.{key}": each.detach().clone()
        for name, module in modules.items()
        for key, each in module.state_dict().items()
    }
    return tensors | {
        f"adam.{name}.{number}.{key}": each.clone()
        for name, optimizer in optimizers.items()
        for number, kept in optimizer.state_dict()["state"].items()
        for key, each in kept.items()
    }


def put_back(
    tensors: Mapping[str, Tensor],
    modules: Mapping[str, nn.Module],
    optimizers: Mapping[str, torch.optim.Adam],
) -> None:
    """Put back what `tensors_of` gave for modules and optimisers of the same kind.

    Raises:
        InputError: names or shapes are others.
    """
    known = set()
    for name, module in modules.items():
        own = {key: f"{name}.{key}" for key in module.state_dict()}
        known |= set(own.values())
        try:
            module.load_state_dict({key: tensors[full] for key, full in own.items()})
        except (KeyError, RuntimeError) as error:
            raise InputError(f"weights of {name} are missing, or of other sizes") from error
    for name, optimizer in optimizers.items():
        described = optimizer.state_dict()
        state: dict[int, dict[str, Tensor]] = {}
        for full in (each for each in tensors if each.startswith(f"adam.{name}.")):
            number, key = full.removeprefix(f"adam.{name}.").split(".")
            state.setdefault(int(number), {})[key] = tensors[full].clone()
            known.add(full)
        optimizer.load_state_dict({**described, "state": state})
    if known != set(tensors):
        raise InputError(f"{min(known ^ set(tensors))} belongs to another kind of training")
