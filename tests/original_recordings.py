"""Recordings as the original DeformableRavens code writes them, pickled by hand, opcode by opcode.

No module that reads or writes pickles is imported: what is written here is read by the importer's
own process alone.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

NUMPY_2 = "numpy._core.multiarray"
NUMPY_1 = "numpy.core.multiarray"
SIZE = (24, 32)
"""Rows and columns of the small views."""


def pickled(value: Any, *, multiarray: str = NUMPY_2) -> bytes:
    """A whole pickle of plain values, arrays and NumPy scalars (protocol 3)."""
    return b"\x80\x03" + opcodes(value, multiarray=multiarray) + b"."


def opcodes(value: Any, *, multiarray: str = NUMPY_2) -> bytes:
    """The opcodes that leave `value` on the stack."""

    def inner(*values: Any) -> bytes:
        return b"".join(opcodes(item, multiarray=multiarray) for item in values)

    if value is None:
        return b"N"
    if isinstance(value, bool):
        return b"\x88" if value else b"\x89"
    if isinstance(value, int):
        return b"I%d\n" % value
    if isinstance(value, np.generic):
        return (
            name(multiarray, "scalar") + b"(" + dtype(value.dtype) + inner(value.tobytes()) + b"tR"
        )
    if isinstance(value, float):
        return b"G" + struct.pack(">d", value)
    if isinstance(value, str):
        text = value.encode()
        return b"X" + struct.pack("<I", len(text)) + text
    if isinstance(value, bytes):
        return b"B" + struct.pack("<I", len(value)) + value
    if isinstance(value, tuple):
        return b"(" + inner(*value) + b"t"
    if isinstance(value, list):
        return b"](" + inner(*value) + b"e"
    if isinstance(value, dict):
        return b"}(" + inner(*(item for pair in value.items() for item in pair)) + b"u"
    if isinstance(value, np.ndarray):
        fortran = value.flags.fnc
        data = value.tobytes(order="F" if fortran else "C")
        state = inner(1, value.shape) + dtype(value.dtype) + inner(fortran, data)
        return array_opcodes(state, multiarray=multiarray)
    raise TypeError(type(value).__name__)


def array_opcodes(
    state: bytes, *, multiarray: str = NUMPY_2, shape: tuple[int, ...] = (0,)
) -> bytes:
    """An array made empty with `shape`, then given the state whose opcodes are `state`."""
    made = name(multiarray, "_reconstruct") + b"(" + name("numpy", "ndarray")
    return made + opcodes(shape) + opcodes(b"b") + b"tR(" + state + b"tb"


def dtype(of: np.dtype, *, fields: Any = None) -> bytes:
    order = {"|": "|"}.get(of.byteorder, ">" if of.byteorder == ">" else "<")
    state = (3, order, None, fields, None, -1, -1, 0)
    made = name("numpy", "dtype") + opcodes((f"{of.kind}{of.itemsize}", False, True)) + b"R"
    return made + opcodes(state) + b"b"


def name(module: str, attribute: str) -> bytes:
    """The opcode that asks for something by name."""
    return f"c{module}\n{attribute}\n".encode()


def camera(yaw: float = 0.0) -> dict[str, Any]:
    """A camera half a metre above the table's middle that looks down."""
    return {
        "image_size": SIZE,
        "intrinsics": (40.0, 0, 16.0, 0, 40.0, 12.0, 0, 0, 1),
        "position": (0.5, 0.0, 0.5),
        "rotation": (np.cos(yaw), np.sin(yaw), 0.0, 0.0),
        "zrange": (0.01, 10.0),
        "noise": False,
    }


def recording(
    steps: int = 2, *, seed: int = 0, objects: Any = None, **extras: Any
) -> dict[str, Any]:
    """The seven parts of an episode, by folder; `extras` are those of every info.

    objects: what an info says about objects, by number; a body by default
    """
    rng = np.random.default_rng(seed)
    colors = rng.integers(0, 256, (steps + 1, 2, *SIZE, 3), np.uint8)
    depths = rng.uniform(0.3, 0.5, (steps + 1, 2, *SIZE)).astype(np.float32)

    def pose() -> tuple[tuple[float, ...], tuple[float, ...]]:
        x, y, half = rng.uniform((0.3, -0.4, -1.5), (0.7, 0.4, 1.5))
        return (np.float64(x), float(y), 0.02), (0.0, 0.0, float(np.sin(half)), float(np.cos(half)))

    def info(t: int) -> dict[int | str, Any]:
        body = {4: (*pose(), (0.08, 0.03, 0.04))}
        return {**(objects or body), "extras": {"task.done": t == steps, **extras}}

    infos = [info(t) for t in range(steps + 1)]
    actions = [
        {
            "camera_config": [camera(), camera(0.3)],
            "primitive": "pick_place",
            "params": {"pose0": pose(), "pose1": pose()},
        }
        for _ in range(steps)
    ]
    return {
        "color": colors[:-1],
        "depth": depths[:-1],
        "action": actions,
        "info": infos[:-1],
        "last_color": colors[-1],
        "last_depth": depths[-1],
        "last_info": infos[-1],
    }


def write(folder: Path, number: int, parts: dict[str, Any], *, multiarray: str = NUMPY_2) -> Path:
    """Store an episode in a task's folder, whose path is returned."""
    for part, value in parts.items():
        path = folder / part / f"{number:06d}-{len(parts['action'])}.pkl"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(pickled(value, multiarray=multiarray))
    return folder
