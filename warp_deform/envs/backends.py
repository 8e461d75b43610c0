"""What a vector environment returns: NumPy arrays, or the same as tensors of torch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, get_args

import numpy as np

from ..errors import InputError

__all__ = ["Backend", "as_backend", "check_backend", "stacked"]

Backend = Literal["numpy", "torch"]


def check_backend(backend: str) -> str:
    """The backend; InputError where there is none of this name."""
    if backend not in get_args(Backend):
        raise InputError(f"backend is one of {', '.join(get_args(Backend))}, not {backend!r}")
    return backend


def stacked(seen: Sequence[Any]) -> Any:
    """Observations one after another as one with a leading dimension, dictionaries entry-wise."""
    if isinstance(seen[0], dict):
        return {name: stacked([one[name] for one in seen]) for name in seen[0]}
    return np.stack(seen)


def as_backend(batch: Any, backend: str) -> Any:
    """An array, or a dictionary of arrays, as it is or as tensors that share its memory."""
    if backend == "numpy":
        return batch
    if isinstance(batch, dict):
        return {name: as_backend(part, backend) for name, part in batch.items()}
    import torch

    return torch.from_numpy(batch)
