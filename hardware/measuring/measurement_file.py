"""Measurements that a person takes one by one: written to a file each, so that a stop loses none.

Guiding an arm from point to point takes minutes, so neither a stop, nor a lost connection, nor a
result that is refused may cost what was measured before.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Generic, TypeVar

from warp_deform.errors import InputError

from ..calibration.poor_fit import PoorFit
from ..choosers.human import TerminalOperator

__all__ = ["MeasurementFile", "gather"]

T = TypeVar("T")
R = TypeVar("R")


class MeasurementFile(Generic[T]):
    """Measurements and their file.

    Args:
        path: the file; one that is there is read
        name: what one of them is called: "view"
        read: returns what a file holds; InputError where it holds something else
        write: writes a file, whole or not at all
    """

    def __init__(
        self,
        path: Path,
        name: str,
        *,
        read: Callable[[Path], list[T]],
        write: Callable[[Path, list[T]], None],
    ) -> None:
        self.path = path
        self.name = name
        self._write = write
        self.items: list[T] = read(path) if path.exists() else []

    def put(self, item: T, *, at: int | None = None) -> None:
        """Add a measurement, or put it in the place of number `at`, and write the file."""
        items = [*self.items, item]
        if at is not None:
            items = [*self.items[:at], item, *self.items[at + 1 :]]
        self._write(self.path, items)
        self.items = items

    def where(self) -> str:
        """Return where they are and what to do with them, for people."""
        if not self.items:
            return "nothing was written"
        count = (
            f"1 {self.name} is" if len(self.items) == 1 else f"{len(self.items)} {self.name}s are"
        )
        return (
            f"{count} kept in {self.path}: the same command continues from there; to begin "
            "anew, remove that file"
        )

    def remove(self) -> None:
        """Remove the file: its measurements are part of a result."""
        self.path.unlink(missing_ok=True)

    @contextlib.contextmanager
    def guarded(self) -> Iterator[None]:
        """Whatever ends the block early also says where the measurements are."""
        try:
            yield
        except InputError as error:
            raise InputError(f"{error}; {self.where()}") from error
        except BaseException:
            if self.items:
                print(self.where(), file=sys.stderr, flush=True)
            raise


def gather(
    measured: MeasurementFile[T],
    *,
    wanted: int,
    take: Callable[[int], T],
    fit: Callable[[list[T]], R],
    operator: TerminalOperator,
) -> R:
    """Return what `wanted` or more measurements give, taking those that are not kept yet.

    Where the result is refused, the one that fits worst is taken again; where none is, or it was
    just that one, one more. The old one stays in the file until the new one is there.

    Args:
        measured: what was taken already, and the file that keeps it
        wanted: how many measurements at least
        take: asks for the measurement of an index and returns it
        fit: their result; InputError, a `PoorFit` if one can be named, where it is refused
        operator: whether to go on with kept ones, and after a refusal

    Raises:
        InputError: stopped
    """
    if measured.items and not operator.wait(measured.where()):
        raise InputError("stopped; what was measured is kept, the same command goes on")
    again: int | None = None
    while True:
        while len(measured.items) < wanted:
            measured.put(take(len(measured.items)))
        try:
            return fit(measured.items)
        except InputError as error:
            if not operator.go_on(error):
                raise
            worst = error.worst if isinstance(error, PoorFit) else None
        if worst is None or worst == again:
            wanted, again = len(measured.items) + 1, None
        else:
            measured.put(take(worst), at=worst)
            again = worst
