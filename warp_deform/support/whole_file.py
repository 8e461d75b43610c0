"""Files that appear whole or not at all, whatever ends the program that writes them."""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Callable, Iterator
from pathlib import Path

__all__ = ["whole_file"]


@contextlib.contextmanager
def whole_file(path: Path, name: Callable[[Path, Path], object] = os.replace) -> Iterator[Path]:
    """A temporary path beside `path`, to write to; the file has its name when the block ends well.

        with whole_file(path) as temporary:
            temporary.write_bytes(data)

    What was written is on the disk before it gets the name. After an error nothing is left, and
    what stood at `path` still does. Writers of one file do not meet: the last one stays.

    Args:
        name: gives the first path, which is complete, the name of the second

    Raises:
        OSError: it cannot be written
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}-{secrets.token_hex(4)}.tmp")
    try:
        yield temporary
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        name(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
