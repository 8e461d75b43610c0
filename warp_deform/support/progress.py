"""How far long work is: a bar for somebody who looks on, plain lines where nobody does.

On a terminal a bar moves on stderr and goes when the work is over. Elsewhere, in a batch job's log
say, a line is printed every `EVERY` seconds and at every milestone: what is done, at which rate,
and how long the rest will take at it. Lines hold no control codes.
"""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

__all__ = ["EVERY", "Advance", "PlainLines", "duration", "progress_bar"]

EVERY = 30.0
"""Between lines [s]."""
_turn = threading.Lock()
"""Held by the work of this process that tells of itself."""


class Advance:
    """What the one who works tells of it; this one keeps it to itself.

    note: a few words to stand beside the number, the loss say; they hold until they are replaced
    """

    def __init__(self) -> None:
        self.note = ""

    def __call__(self, steps: int = 1) -> None:
        """So many more are done."""

    def milestone(self) -> None:
        """Something worth a line was reached."""


class PlainLines(Advance):
    """Tells of work line by line.

    Args:
        what: is done
        total: of what is counted, in `unit`; done: before now
        tell: takes a line
        clock: seconds since whenever
    """

    def __init__(
        self,
        what: str,
        total: int,
        *,
        done: int = 0,
        unit: str = "episodes",
        tell: Callable[[str], object],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__()
        self._what, self._total, self._unit = what, total, unit
        self._tell, self._clock = tell, clock
        self._before = self._done = done
        self._began = clock()

    def __call__(self, steps: int = 1) -> None:
        """So many more are done."""
        self._done += steps

    def milestone(self) -> None:
        """Print a line now."""
        self._tell(self.line())

    def line(self) -> str:
        """Where the work is now.

        The rate is that since the beginning of this run: what was done before it took no time.
        """
        seconds, done = self._clock() - self._began, self._done - self._before
        parts = [f"{self._what}: {self._done} of {self._total} {self._unit}"]
        if self.note:
            parts.append(self.note)
        parts.append(f"{duration(seconds)} so far")
        if done > 0 and seconds > 0:
            rate = done / seconds
            parts.append(f"{rate:.3g} a second" if rate >= 1 else f"{60 * rate:.3g} a minute")
            left = (self._total - self._done) / rate
            parts.append(f"{duration(left)} left" if left > 0 else "done")
        return ", ".join(parts)

    @contextlib.contextmanager
    def every(self, seconds: float) -> Iterator[PlainLines]:
        """Print a line so often, also while a single step takes longer than that."""
        over = threading.Event()

        def beat() -> None:
            while not over.wait(seconds):
                self.milestone()

        beating = threading.Thread(target=beat, name="progress", daemon=True)
        beating.start()
        try:
            yield self
        finally:
            over.set()
            beating.join()


class _Bar(Advance):
    """Moves a bar."""

    def __init__(self, move: Callable[[int], object]) -> None:
        super().__init__()
        self._move = move

    def __call__(self, steps: int = 1) -> None:
        """So many more are done."""
        self._move(steps)


@contextlib.contextmanager
def progress_bar(
    what: str, total: int, *, done: int = 0, unit: str = "episodes", shown: bool = True
) -> Iterator[Advance]:
    """Show how far work is, on stderr: a bar on a terminal, plain lines elsewhere.

    Gives what moves it on, by 1 or by its argument. Lines that are printed meanwhile stand above a
    bar. Work that is part of work that tells of itself, or is not to, is silent: goals that are
    made for an evaluation, say.
    """
    if not _turn.acquire(blocking=False):
        yield Advance()
        return
    try:
        if not shown:
            yield Advance()
            return
        with _shown(what, total, done, unit) as advance:
            yield advance
    finally:
        _turn.release()


@contextlib.contextmanager
def _shown(what: str, total: int, done: int, unit: str) -> Iterator[Advance]:
    console = Console(stderr=True)
    if sys.stderr.isatty() and console.is_terminal and not console.is_dumb_terminal:
        columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()
        with Progress(*columns, TimeRemainingColumn(), console=console, transient=True) as bars:
            bar = bars.add_task(what, total=total, completed=done)
            yield _Bar(lambda steps: bars.advance(bar, steps))
    else:
        lines = PlainLines(what, total, done=done, unit=unit, tell=_say)
        with lines.every(EVERY):
            yield lines


def duration(seconds: float) -> str:
    """Seconds in a form to read.

    Examples:
        >>> [duration(s) for s in (0.4, 42, 119.6, 3599, 4 * 3600 + 130)]
        ['0 s', '42 s', '2 min', '1 h 0 min', '4 h 2 min']
    """
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
