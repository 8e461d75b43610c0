"""Pickles of arrays, dicts, lists and numbers, read by a process that can do nothing else.

A pickle is a program. This one place runs such programs, on data of the original benchmark, in a
process of its own (see `_pickle_process`): without a single class or function but recorders of
NumPy's plain arrays and numbers, with bounds on memory, time, size and depth, and unable to write
files or start processes. What comes back is JSON and raw numbers, which are checked again here.
"""

from __future__ import annotations

import json
import math
import re
import stat
import struct
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from warp_deform.errors import InputError

__all__ = ["MOST_BYTES", "read_pickles"]

MOST_BYTES = 2**28
"""Largest file that is read: three times the depth pictures of 20 actions."""

_MOST_TEXT_BYTES = 2**26
_SECONDS_A_FILE = 60.0
_DTYPE = re.compile(r"[<>|](b1|[iu][1248]|f[248])")
_PROGRAM = Path(__file__).with_name("_pickle_process.py")


def read_pickles(paths: Sequence[Path]) -> list[Any]:
    """What each file holds: None, bool, int, float, str, list (tuples too), dict and ndarray.

    Arrays are read-only.

    Raises:
        InputError: a file is missing, too large, damaged, or asks for anything but NumPy's plain
            arrays and numbers, which is named and was not run.
    """
    for path in paths:
        _check_file(path)
    # -I and -S: no environment variable, no site package, no current folder
    command = [sys.executable, "-I", "-S", str(_PROGRAM), str(MOST_BYTES)]
    with subprocess.Popen(
        [*command, *(str(path.absolute()) for path in paths)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    ) as process:
        assert process.stdout is not None
        timer = threading.Timer(_SECONDS_A_FILE * len(paths), process.kill)
        timer.start()
        try:
            return [_receive(process.stdout, path) for path in paths]
        finally:
            timer.cancel()
            process.kill()  # after the last answer it has nothing left to do


def _check_file(path: Path) -> None:
    try:
        status = path.stat()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from error
    if not stat.S_ISREG(status.st_mode):
        raise InputError(f"{path} is no file")
    if status.st_size > MOST_BYTES:
        raise InputError(f"{path} has {status.st_size} bytes; at most {MOST_BYTES} are read")


def _receive(stream: IO[bytes], path: Path) -> Any:
    (length,) = struct.unpack(">Q", _exactly(stream, 8, path))
    if length > _MOST_TEXT_BYTES:
        raise InputError(f"{path} holds more than is read: {length} bytes beside its arrays")
    report = json.loads(_exactly(stream, length, path))
    if "refused" in report:
        raise InputError(f"{path} {report['refused']}")
    arrays = list(_arrays(stream, report["arrays"], path))
    return _value(report["value"], arrays)


def _arrays(stream: IO[bytes], described: list[dict[str, Any]], path: Path) -> Iterator[np.ndarray]:
    left = MOST_BYTES
    for entry in described:
        size, shape = int(entry["bytes"]), tuple(map(int, entry["shape"]))
        left -= size
        if left < 0 or not _DTYPE.fullmatch(entry["dtype"]):
            raise InputError(f"{path} holds an array that is not read")
        dtype = np.dtype(entry["dtype"])
        if math.prod(shape) * dtype.itemsize != size:
            raise InputError(f"{path} holds an array that is not read")
        flat = np.frombuffer(_exactly(stream, size, path), dtype)
        yield flat.reshape(shape, order="F" if entry["fortran"] else "C")


def _exactly(stream: IO[bytes], count: int, path: Path) -> bytes:
    data = stream.read(count)
    if len(data) != count:
        raise InputError(f"{path} takes too much time or memory to read, or is no data at all")
    return data


def _value(tree: Any, arrays: list[np.ndarray]) -> Any:
    if isinstance(tree, list):
        return [_value(item, arrays) for item in tree]
    if isinstance(tree, dict):
        if "array" in tree:
            return arrays[tree["array"]]
        return {key: _value(value, arrays) for key, value in tree["dict"]}
    return tree
