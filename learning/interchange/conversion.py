"""What all conversions share: a destination that appears whole or not at all, a bar, a report."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from warp_deform.errors import InputError

__all__ = ["ConversionReport", "new_file", "new_folder", "size_of"]

_MARK = "conversion.json"


@dataclass(frozen=True, kw_only=True)
class ConversionReport:
    """What a conversion made.

    Attributes:
        steps: actions of all episodes
        bytes: size on the disk
        seconds: what this run took [s]
    """

    format: str
    out: Path
    task: str
    episodes: int
    steps: int
    bytes: int
    seconds: float


@contextlib.contextmanager
def new_folder(
    target: Path, *, description: Mapping[str, Any], resume: bool = False
) -> Iterator[Path]:
    """A hidden folder beside `target` to write into; it gets its name when the block ends well.

    Args:
        description: what is converted, JSON types
        resume: keep what an interrupted run of the same description left, in the folder that is
            given; else it is removed

    Raises:
        InputError: there is something at `target` already, it cannot be written, or another
            process is writing it.
    """
    target = Path(target).absolute()
    _check_absent(target)
    partial = target.with_name(f".{target.name}.partial")
    try:
        partial.mkdir(parents=True, exist_ok=True)
        lock = os.open(partial, os.O_RDONLY | os.O_DIRECTORY)
    except OSError as error:
        raise InputError(f"{target} cannot be made: {error.strerror}") from error
    try:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise InputError(f"another process is converting into {target}") from error
        _prepare(partial, dict(description), resume=resume)
        try:
            yield partial
        except BaseException:
            if not resume:
                shutil.rmtree(partial)
            raise
        (partial / _MARK).unlink()
        partial.rename(target)
    finally:
        os.close(lock)


def _check_absent(target: Path) -> None:
    if target.is_dir() and not any(target.iterdir()):
        return
    if target.exists() or target.is_symlink():
        raise InputError(f"{target} exists already; choose another destination or remove it")


def _prepare(partial: Path, description: dict[str, Any], *, resume: bool) -> None:
    """Leave in the folder what may be gone on with, and the mark that makes it ours."""
    mark = partial / _MARK
    if any(partial.iterdir()) and not mark.exists():
        raise InputError(f"{partial} is in the way; remove it")
    if mark.exists():
        try:
            same = json.loads(mark.read_bytes()) == description
        except (OSError, ValueError, RecursionError):
            same = False
        if same and resume:
            return
        # the mark goes last: a folder that is half removed is still known as ours
        for path in sorted(partial.iterdir(), key=lambda path: path.name == _MARK):
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink()
    mark.write_text(json.dumps(description, indent=1) + "\n")


@contextlib.contextmanager
def new_file(target: Path) -> Iterator[Path]:
    """A hidden file's path beside `target`; the file gets its name when the block ends well.

    Raises:
        InputError: there is something at `target` already, or it cannot be written.
    """
    target = Path(target).absolute()
    if target.exists() or target.is_symlink():
        raise InputError(f"{target} exists already; choose another destination or remove it")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{target} cannot be made: {error.strerror}") from error
    if not os.access(target.parent, os.W_OK):
        raise InputError(f"the folder {target.parent} is not writable; choose another place")
    partial = target.with_name(f".{target.name}.{os.getpid()}.partial")
    try:
        yield partial
        partial.rename(target)
    finally:
        partial.unlink(missing_ok=True)


def size_of(path: Path) -> int:
    """Bytes of a file, or of all files in a folder."""
    if path.is_file():
        return path.stat().st_size
    return sum(inner.stat().st_size for inner in path.rglob("*") if inner.is_file())
