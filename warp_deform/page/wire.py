"""Messages between server and page.

To the page: binary, little-endian. A uint32 length, a JSON head of that length whose `arrays` lists
[name, "f4" | "u4" | "u1", shape], zeros up to a multiple of 4 bytes, then the arrays, each filled
up likewise. To the server: one JSON object as text, at most `MOST_BYTES`, whose `do` names a verb.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import InputError, WarpDeformError

__all__ = ["MOST_BYTES", "Job", "NotUnderstoodError", "Verbs", "pack", "parse_job", "unpack"]

MOST_BYTES = 4096
"""Longest message that a page may send."""
_CODES = {"float32": "f4", "uint32": "u4", "uint8": "u1"}
_TYPES = {code: np.dtype(name).newbyteorder("<") for name, code in _CODES.items()}

Verbs = Mapping[str, Mapping[str, type]]
"""The verbs of a session, and of each the names and types of what comes with it."""


class NotUnderstoodError(WarpDeformError):
    """A message that no page of ours sends."""


@dataclass(frozen=True)
class Job:
    """What a page asks for.

    Attributes:
        at: the version of the state that the page shows, -1 where it does not matter
    """

    do: str
    values: Mapping[str, Any]
    at: int = -1

    def number(self, name: str) -> float:
        """A finite number; InputError if it is none."""
        return _finite(self.values[name], name)

    def numbers(self, name: str, count: int) -> list[float]:
        """So many finite numbers; InputError if they are not."""
        values = self.values[name]
        if len(values) != count:
            raise InputError(f"{name} has {len(values)} numbers; {count} are needed")
        return [_finite(value, name) for value in values]


def _finite(value: object, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{name} is {str(value)[:40]!r}, not a number")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise InputError(f"{name} is {str(value)[:40]}, not a finite number")
    return number


def parse_job(raw: str | bytes, verbs: Verbs) -> Job:
    """What a page's message asks for.

    The values of a known verb may still be wrong: their types are looked at when they are used, so
    that the person at the page is told.

    Raises:
        NotUnderstoodError: it is no JSON object, has no known verb, or other names than the verb's.
        InputError: a value is of another type than the verb's.
    """
    if not isinstance(raw, str):
        raise NotUnderstoodError("bytes instead of text")
    try:
        record = json.loads(raw, parse_constant=_refuse)
    except (ValueError, RecursionError) as error:
        raise NotUnderstoodError("no JSON") from error
    if not isinstance(record, dict) or not isinstance(record.get("do"), str):
        raise NotUnderstoodError("no verb")
    do, at = record.pop("do"), record.pop("at", -1)
    if do not in verbs or record.keys() != verbs[do].keys():
        raise NotUnderstoodError("no such verb, or other names with it")
    if type(at) is not int:
        raise NotUnderstoodError("no version of a state")
    for name, kind in verbs[do].items():
        value = record[name]
        fits = type(value) is kind or (kind is float and type(value) is int)
        if not fits:
            raise InputError(f"{name} is {str(value)[:40]!r}, not what {do} needs")
    return Job(do, record, at)


def _refuse(name: str) -> Any:
    raise ValueError(f"{name} is no JSON number")


def pack(kind: str, arrays: Mapping[str, np.ndarray] | None = None, **head: Any) -> bytes:
    """A message to the page; float32, uint32 and uint8 arrays, all finite.

    Raises:
        ValueError: a number is not finite: pages are never sent what cannot be drawn.
    """
    whole = {name: np.ascontiguousarray(array) for name, array in (arrays or {}).items()}
    for name, array in whole.items():
        if array.dtype == np.float32 and not np.isfinite(array).all():
            raise ValueError(f"{name} of a message {kind!r} is not finite")
    described = [[name, _CODES[str(array.dtype)], array.shape] for name, array in whole.items()]
    text = json.dumps({"kind": kind, **head, "arrays": described}, allow_nan=False).encode()
    parts = [struct.pack("<I", len(text)) + text]
    for array in whole.values():
        parts.append(array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes())
    return b"".join(part + bytes(-len(part) % 4) for part in parts)


def unpack(message: bytes) -> dict[str, Any]:
    """The head of a message of `pack`, its arrays under their names."""
    length = struct.unpack_from("<I", message)[0]
    head: dict[str, Any] = json.loads(message[4 : 4 + length])
    at = 4 + length + (-(4 + length) % 4)
    for name, code, shape in head.pop("arrays"):
        count = math.prod(shape)
        head[name] = np.frombuffer(message, _TYPES[code], count, at).reshape(shape)
        at += head[name].nbytes + (-head[name].nbytes % 4)
    return head
