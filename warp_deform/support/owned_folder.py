"""A folder that one process at a time writes to."""

from __future__ import annotations

import contextlib
import fcntl
from collections.abc import Iterator
from pathlib import Path

from ..errors import InputError

__all__ = ["owned_folder"]


@contextlib.contextmanager
def owned_folder(out: Path, *, lock: str, work: str) -> Iterator[None]:
    """Hold a folder against others who do the same; it ends with the process, however that ends.

    A folder that was made for work which then fails before there is anything in it goes again.

    Args:
        out: the folder, made where it is missing
        lock: name of the file in it that is locked
        work: what is done there, for messages ("sweep")

    Raises:
        InputError: the folder cannot be made, or another process holds it.
    """
    made = [folder for folder in (out, *out.parents) if not folder.exists()]
    path = out / lock
    try:
        out.mkdir(parents=True, exist_ok=True)
        file = path.open("a")
    except OSError as error:
        raise InputError(f"out {out} cannot be made: {error.strerror}") from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise InputError(f"another {work} is at work in {out}; wait for it to end") from error
        try:
            yield
        except Exception:
            if [each.name for each in out.iterdir()] == [path.name]:
                path.unlink()
                for folder in made:
                    with contextlib.suppress(OSError):  # it holds something else
                        folder.rmdir()
            raise
