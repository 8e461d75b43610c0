"""How far long work is, for somebody who looks on."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

__all__ = ["progress_bar"]


@contextlib.contextmanager
def progress_bar(
    what: str, total: int, *, done: int = 0, shown: bool = True
) -> Iterator[Callable[..., None]]:
    """A bar on stderr, where that is a terminal; gives what moves it on, by 1 or by its argument.

    Lines printed meanwhile stand above it.
    """
    console = Console(stderr=True)
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()
    hidden = not (shown and console.is_terminal)
    with Progress(
        *columns, TimeRemainingColumn(), console=console, transient=True, disable=hidden
    ) as bars:
        bar = bars.add_task(what, total=total, completed=done)

        def advance(steps: int = 1) -> None:
            bars.advance(bar, steps)

        yield advance
