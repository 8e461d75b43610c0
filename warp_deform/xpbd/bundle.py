"""Bundles: a file that reproduces the launch in which a guard fired."""

from __future__ import annotations

import hashlib
import json
import zipfile
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from ..errors import InputError
from .kernels.forward import forward_kernel
from .lanes.structures import structures
from .packing.data import KERNEL_ARGUMENTS, SolverData, alias_lanes

__all__ = ["replay_bundle", "write_bundle"]

_VARIANT = ("bodies", "sheets", "edges", "lines")
_HEADER = {"digest", "lanes", "precision", "groups", "settings", *_VARIANT}
_SETTINGS = ("dt", "max_steps", "recovery", "max_speed", "calm_speed", "margin",
             "rest_speed", "rest_steps", "viscous", "damp_every", "sleep", "sleep_after", "wake",
             "sleep_ramp", "check_every", "record_every", "particle_stride",
             "body_stride")  # fmt: skip


def write_bundle(
    folder: Path, data: SolverData, settings: Any, arrays: dict[str, np.ndarray]
) -> Path:
    """Write all inputs of a launch, `arrays` by name, to an .npz file named after their hash."""
    folder.mkdir(parents=True, exist_ok=True)
    header = {
        "lanes": data.lanes,
        "precision": np.dtype(data.number).name,
        "bodies": bool(data.has_bodies),
        "sheets": bool(data.has_sheets),
        "edges": bool(data.has_edges),
        "lines": bool(data.has_lines),
        "groups": data.group_count,
        "settings": {name: getattr(settings, name) for name in _SETTINGS},
    }
    header["digest"] = digest = _digest(header, arrays)
    path = folder / f"launch_{digest}.npz"
    np.savez(path, header=np.frombuffer(json.dumps(header).encode(), np.uint8), **arrays)
    return path


def _digest(header: dict[str, Any], arrays: dict[str, np.ndarray]) -> str:
    """Hash of the header and of the arrays' names, shapes, types and bytes."""
    digest = hashlib.blake2b(json.dumps(header, sort_keys=True).encode(), digest_size=8)
    for name in sorted(arrays):
        values = arrays[name]
        digest.update(f"{name} {values.shape} {values.dtype.str}".encode())
        digest.update(values.tobytes())
    return digest.hexdigest()


def _read(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header and arrays of a bundle.

    Raises:
        InputError: the file is not a bundle, or damaged. The digest is no signature, and the kernel
            trusts the numbers in the file: replay bundles of your own only.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            names = [name.removesuffix(".npy") for name in archive.namelist()]
            values = {
                n: np.load(BytesIO(archive.read(f"{n}.npy")), allow_pickle=False) for n in names
            }
        header = json.loads(values.pop("header").tobytes())
        known = set(header) == _HEADER and set(header["settings"]) == set(_SETTINGS)
    except (OSError, ValueError, KeyError, EOFError, TypeError, zipfile.BadZipFile) as error:
        raise InputError(f"{path} is not a bundle of a launch: {error}") from error
    if not known or header.pop("digest") != _digest(header, values):
        raise InputError(f"{path} is not a bundle of this version, or it was changed")
    return header, values


def replay_bundle(path: str | Path) -> dict[str, np.ndarray]:
    """Run the launch of a bundle again on the CPU; returns all arrays after it, by name.

    Raises:
        InputError: the file is not a bundle, or was changed since it was written.
    """
    header, arrays = _read(Path(path))
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
    alias_lanes(structs, scalar)
    kernel = forward_kernel(scalar, header["lanes"], *(header[name] for name in _VARIANT))
    wp.launch(kernel, dim=header["groups"], inputs=[settings, *structs, 0], device="cpu")
    return {
        key: array.numpy().view(dtype).reshape(shape).copy() for key, array, shape, dtype in held
    }


def _array(types: SimpleNamespace, struct: str, field: str, values: np.ndarray) -> wp.array:
    """A Warp array of the struct's own element type from raw scalars."""
    dtype = getattr(types, struct.capitalize()).vars[field].type.dtype
    array = wp.zeros(len(values), dtype=dtype, device="cpu")
    array.numpy().view(values.dtype).reshape(values.shape)[...] = values
    return array
