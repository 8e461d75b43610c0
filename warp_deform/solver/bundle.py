"""Bundles: a file that reproduces the launch in which a guard fired."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..errors import InputError
from .data import KERNEL_ARGUMENTS
from .forward import forward_kernel
from .structures import structures

if TYPE_CHECKING:
    from .solver import SolverFusedXPBD

__all__: list[str] = []  # `warp_deform.solver` is the import path of what is here

_SETTINGS = ("dt", "max_steps", "alternate", "recovery", "max_speed", "calm_speed", "margin",
             "rest_speed", "rest_steps", "check_every", "record_every", "particle_stride",
             "body_stride")  # fmt: skip


def write_bundle(folder: Path, solver: SolverFusedXPBD) -> Path:
    """Write all inputs of the solver's last launch to an .npz file named after their hash."""
    folder.mkdir(parents=True, exist_ok=True)
    arrays = solver._bundle or {}
    settings, _, _ = solver._last
    header = {
        "lanes": solver.data.lanes,
        "precision": np.dtype(solver.data.number).name,
        "bodies": bool(solver.data.has_bodies),
        "groups": solver.data.group_count,
        "settings": {name: getattr(settings, name) for name in _SETTINGS},
    }
    digest = hashlib.blake2b(digest_size=8)
    for name in sorted(arrays):
        digest.update(arrays[name].tobytes())
    path = folder / f"launch_{digest.hexdigest()}.npz"
    np.savez(path, header=np.frombuffer(json.dumps(header).encode(), np.uint8), **arrays)
    return path


def replay_bundle(path: str | Path) -> dict[str, np.ndarray]:
    """Run the launch of a bundle again on the CPU; returns all arrays after it, by name.

    Raises:
        InputError: the file is not a bundle.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            header = json.loads(file["header"].tobytes())
            arrays = {name: file[name] for name in file.files if name != "header"}
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"{path} is not a bundle of a launch: {error}") from error
    scalar = {"float32": wp.float32, "float64": wp.float64}[header["precision"]]
    types = structures(scalar, header["lanes"])
    settings = types.Settings()
    for name, value in header["settings"].items():
        setattr(settings, name, value)
    structs, held = [], []
    for name in KERNEL_ARGUMENTS:
        struct = getattr(types, name.capitalize())()
        for key, values in arrays.items():
            owner, field = key.split(".")
            if owner == name:
                array = _array(types, name, field, values)
                held.append((key, array, values.shape, values.dtype))
                setattr(struct, field, array)
        structs.append(struct)
    kernel = forward_kernel(scalar, header["lanes"], header["bodies"])
    wp.launch(kernel, dim=header["groups"], inputs=[settings, *structs], device="cpu")
    return {
        key: array.numpy().view(dtype).reshape(shape).copy() for key, array, shape, dtype in held
    }


def _array(types: SimpleNamespace, struct: str, field: str, values: np.ndarray) -> wp.array:
    """A Warp array of the struct's own element type from raw scalars."""
    dtype = getattr(types, struct.capitalize()).vars[field].type.dtype
    array = wp.zeros(len(values), dtype=dtype, device="cpu")
    array.numpy().view(values.dtype).reshape(values.shape)[...] = values
    return array
