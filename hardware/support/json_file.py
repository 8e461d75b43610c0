"""Files that people keep and edit: written whole or not at all; JSON read with one-line errors."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from warp_deform.errors import InputError
from warp_deform.support.whole_file import whole_file

__all__ = ["read_json", "read_numbers", "require", "write_json", "write_whole"]

_MAX_BYTES = 2**24


def write_json(path: Path, record: dict[str, Any]) -> None:
    """Write the record as `write_whole` does."""
    text = json.dumps(record, indent=1, allow_nan=False, ensure_ascii=False) + "\n"
    write_whole(path, text.encode())


def write_whole(path: Path, data: bytes) -> None:
    """Write a file, whole or not at all.

    Raises:
        InputError: it cannot be written; what stood there before still does
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(path) as temporary:
            temporary.write_bytes(data)
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror}; choose another") from error


def read_json(path: Path, *, what: str, schema: int) -> dict[str, Any]:
    """Return the JSON object in a file.

    Args:
        path: the file
        what: what the file is, for the message: "calibration"
        schema: the value its key `schema` must have

    Raises:
        InputError: no such file, no JSON object, or of another schema
    """
    try:
        with path.open("rb") as file:
            data = file.read(_MAX_BYTES + 1)
    except OSError as error:
        raise InputError(f"{what} {path} cannot be read: {error.strerror}") from error
    if len(data) > _MAX_BYTES:
        raise InputError(f"{what} {path} has more than {_MAX_BYTES} bytes; it is another file")
    try:
        record = json.loads(data, parse_constant=_refuse)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{what} {path} is not JSON; make it anew") from error
    if not isinstance(record, dict) or type(record.get("schema")) is not int:
        raise InputError(f"{what} {path} names no schema version; make it anew")
    if record["schema"] != schema:
        raise InputError(
            f"{what} {path} has schema version {record['schema']}, and this release reads "
            f"{schema}; make it anew"
        )
    return record


def require(record: Any, key: str, kind: type, *, what: str) -> Any:
    """Return `record[key]`; InputError unless it is there and a `kind`.

    An integer stands for a float, but True for neither.
    """
    value = record.get(key) if isinstance(record, dict) else None
    right = type(value) is kind or (kind is float and type(value) is int)
    if not right or (isinstance(value, float) and not math.isfinite(value)):
        raise InputError(f"{what}: {key} is {str(value)[:60]}, expected {kind.__name__}")
    return value


def read_numbers(record: Any, key: str, shape: tuple[int, ...], *, what: str) -> np.ndarray:
    """Return `record[key]` as finite float64 of `shape`, where -1 stands for any length.

    Raises:
        InputError: it is something else
    """
    value = require(record, key, list, what=what)
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{what}: {key} holds something else than numbers") from error
    fits = array.ndim == len(shape) and all(
        wanted in (-1, length) for wanted, length in zip(shape, array.shape, strict=True)
    )
    if not fits or not np.isfinite(array).all():
        wanted_text = str(shape).replace("-1", "any")
        raise InputError(f"{what}: {key} is not {wanted_text} finite numbers")
    return array


def _refuse(name: str) -> Any:
    raise ValueError(f"{name} is no JSON number")
