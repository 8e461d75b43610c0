"""The process in which pickles of arrays are taken apart; `restricted_pickle` starts it.

Nothing here is numpy's or anybody else's: the six names that pickles of arrays and NumPy scalars
contain stand for the small recorders below, and every other name ends the reading before anything
is made or called. Run as `python -I -S _pickle_process.py MOST_BYTES FILE...`, with the standard
library alone. For every file it writes to stdout the length of a JSON text (8 bytes, big-endian),
the text, and the bytes of the arrays that the text lists.

The text is {"refused": why} or {"value": tree, "arrays": [{"dtype", "shape", "fortran", "bytes"}]}.
In a tree lists and tuples are lists, a dict is {"dict": [[key, value], ...]} and an array is
{"array": its number}.
"""

from __future__ import annotations

import json
import pickle
import resource
import struct
import sys
from collections.abc import Callable
from typing import Any, BinaryIO

_MOST_VALUES = 1_000_000
_MOST_DEPTH = 24
_MOST_TEXT = 10_000
_MOST_AXES = 8
_CPU_SECONDS = 60
_SPARE_BYTES = 2**28  # the interpreter itself, and what is being assembled
# struct's code of every dtype that is read
_CODES = {
    "b1": "?", "i1": "b", "i2": "h", "i4": "i", "i8": "q", "u1": "B", "u2": "H", "u4": "I",
    "u8": "Q", "f2": "e", "f4": "f", "f8": "d",
}  # fmt: skip


class Refused(Exception):
    """The file is none that is read; says why."""


class _Dtype:
    """What `numpy.dtype(name, align, copy)` and its state say: a plain number's type."""

    __slots__ = ("name", "order")

    def __init__(self, name: object, align: object = False, copy: object = False) -> None:
        if type(name) is not str or name not in _CODES:
            raise Refused(f"holds values of type {_shown(name)}, which are no plain numbers")
        self.name, self.order = name, "|"

    def __setstate__(self, state: object) -> None:
        if type(state) is not tuple or len(state) not in (8, 9) or state[2:5] != (None,) * 3:
            raise Refused("holds an array of structured values")
        if state[1] not in ("<", ">", "|"):
            raise Refused("holds numbers of an unknown byte order")
        self.order = state[1]

    @property
    def size(self) -> int:
        return int(self.name[1:])


class _Array:
    """What an array's state says."""

    __slots__ = ("data", "dtype", "fortran", "shape")

    def __setstate__(self, state: object) -> None:
        if type(state) is not tuple or len(state) != 5:
            raise Refused("holds an array in an unknown form")
        _, shape, dtype, fortran, data = state
        if type(shape) is not tuple or len(shape) > _MOST_AXES or type(dtype) is not _Dtype:
            raise Refused("holds an array in an unknown form")
        if type(data) is not bytes:
            raise Refused("holds an array of objects")
        count = 1
        for length in shape:
            if type(length) is not int or length < 0:
                raise Refused("holds an array of impossible shape")
            count *= length
        if count * dtype.size != len(data):
            raise Refused(f"holds {len(data)} bytes for an array of {_shown(shape)}")
        self.shape, self.dtype, self.fortran, self.data = shape, dtype, bool(fortran), data


class _Name:
    """What a name in a pickle stands for: it can be called at most, never changed."""

    __slots__ = ("_call",)

    def __init__(self, call: Callable[..., Any]) -> None:
        self._call = call

    def __call__(self, *arguments: object) -> Any:
        return self._call(*arguments)

    def __setstate__(self, state: object) -> None:
        raise Refused("changes a function")


def _no_call(*arguments: object) -> Any:
    raise Refused("makes an array in an unknown form")


def _reconstruct(kind: object, shape: object, code: object) -> _Array:
    if kind is not _NDARRAY or shape != (0,) or code not in (b"b", "b"):
        raise Refused("makes an array in an unknown form")
    return _Array()


def _scalar(dtype: object, data: object) -> bool | int | float:
    if type(dtype) is not _Dtype or type(data) is not bytes or len(data) != dtype.size:
        raise Refused("holds a number in an unknown form")
    value: bool | int | float
    (value,) = struct.unpack(dtype.order.replace("|", "=") + _CODES[dtype.name], data)
    return value


_NDARRAY = _Name(_no_call)
_FUNCTIONS = {"_reconstruct": _Name(_reconstruct), "scalar": _Name(_scalar)}
_NAMES = {
    ("numpy", "ndarray"): _NDARRAY,
    ("numpy", "dtype"): _Name(_Dtype),
    # NumPy 1 and 2
    **{("numpy.core.multiarray", name): stand_in for name, stand_in in _FUNCTIONS.items()},
    **{("numpy._core.multiarray", name): stand_in for name, stand_in in _FUNCTIONS.items()},
}


class _Unpickler(pickle.Unpickler):
    """Knows the names above and no other: it imports nothing."""

    def find_class(self, module: str, name: str) -> Any:
        known = _NAMES.get((module, name))
        if known is None:
            asked = _shown(f"{module}.{name}")
            raise Refused(f"asks for {asked}; only NumPy's plain arrays and numbers are read")
        return known

    def persistent_load(self, pid: Any) -> Any:
        raise Refused("refers to objects outside of itself")


class _Tree:
    """JSON of what was read, and the arrays in it; every array counts once."""

    def __init__(self) -> None:
        self.arrays: list[_Array] = []
        self._numbers: dict[int, int] = {}
        self._left = _MOST_VALUES

    def of(self, value: Any, depth: int = 0) -> Any:
        self._left -= 1
        if self._left < 0 or depth > _MOST_DEPTH:
            raise Refused(f"nests more than {_MOST_VALUES} values or {_MOST_DEPTH} levels")
        kind = type(value)
        if value is None or kind in (bool, float):
            return value
        if kind is int and -(2**63) <= value < 2**64:
            return value
        if kind is str and len(value) <= _MOST_TEXT:
            return value
        if kind in (list, tuple):
            return [self.of(item, depth + 1) for item in value]
        if kind is dict:
            return {"dict": [[self._key(k), self.of(v, depth + 1)] for k, v in value.items()]}
        if kind is _Array and hasattr(value, "data"):
            number = self._numbers.setdefault(id(value), len(self.arrays))
            if number == len(self.arrays):
                self.arrays.append(value)
            return {"array": number}
        raise Refused(f"holds a value of type {kind.__name__.lstrip('_')} that is not read")

    def _key(self, key: object) -> int | str:
        if type(key) is int and abs(key) < 2**63:
            return key
        if type(key) is str and len(key) <= _MOST_TEXT:
            return key
        raise Refused("holds a dict whose keys are neither texts nor whole numbers")


def _shown(value: object) -> str:
    return ascii(value)[:80]


def _limit(most_bytes: int) -> None:
    """Bound memory and time, and take away the right to write files or start processes."""
    memory = 3 * most_bytes + _SPARE_BYTES
    for kind, wanted in (
        (resource.RLIMIT_AS, memory),
        (resource.RLIMIT_CPU, _CPU_SECONDS),
        (resource.RLIMIT_FSIZE, 0),
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_NPROC, 0),
    ):
        _, hard = resource.getrlimit(kind)
        limit = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
        resource.setrlimit(kind, (limit, limit))


class _Guard:
    """While it holds, Python's audit events (imports, files, processes, sockets) end the reading.

    The second lock: nothing that is read above can cause such an event.
    """

    def __init__(self) -> None:
        self.on = False
        sys.addaudithook(self._hear)

    def _hear(self, event: str, arguments: object) -> None:
        if self.on:
            self.on = False
            raise Refused(f"does what no data does ({_shown(event)})")


def _read(file: BinaryIO, most_bytes: int, guard: _Guard) -> tuple[Any, list[_Array]]:
    """What a file holds, as JSON types and arrays."""
    unpickler = _Unpickler(file)
    guard.on = True
    try:
        value = unpickler.load()
        guard.on = False
        if file.read(1):
            raise Refused("holds more than one value")
        tree = _Tree()
        json_tree = tree.of(value)
    except MemoryError:
        raise Refused("asks for more memory than such data needs") from None
    except RecursionError:
        raise Refused("nests too deeply") from None
    except Refused:
        raise
    except Exception as error:  # what a damaged or forged file makes an unpickler raise is open
        raise Refused(f"is damaged ({type(error).__name__}: {str(error)[:120]})") from None
    finally:
        guard.on = False
    if sum(len(array.data) for array in tree.arrays) > most_bytes:
        raise Refused(f"holds more than {most_bytes} bytes")
    return json_tree, tree.arrays


def _main(most_bytes: int, paths: list[str]) -> None:
    _limit(most_bytes)
    guard = _Guard()
    out = sys.stdout.buffer
    for path in paths:
        arrays: list[_Array] = []
        try:
            with open(path, "rb") as file:
                value, arrays = _read(file, most_bytes, guard)
            described = [
                {
                    "dtype": array.dtype.order + array.dtype.name,
                    "shape": array.shape,
                    "fortran": array.fortran,
                    "bytes": len(array.data),
                }
                for array in arrays
            ]
            report = {"value": value, "arrays": described}
        except Refused as refused:
            report, arrays = {"refused": str(refused)}, []
        except OSError as error:
            report = {"refused": f"cannot be read: {error.strerror}"}
        text = json.dumps(report).encode()
        out.write(struct.pack(">Q", len(text)) + text)
        for array in arrays:
            out.write(array.data)
        out.flush()


if __name__ == "__main__":
    _main(int(sys.argv[1]), sys.argv[2:])
