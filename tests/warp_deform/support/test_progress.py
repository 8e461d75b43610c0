"""Long work tells how far it is: lines without control codes off a terminal, a bar on one."""

from __future__ import annotations

import io
import sys
import threading

import pytest

from warp_deform.support import progress
from warp_deform.support.progress import Advance, PlainLines, duration, progress_bar


class Clock:
    """A clock that stands until it is moved."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


def made(total: int = 4000, **options: object) -> tuple[PlainLines, list[str], Clock]:
    printed: list[str] = []
    clock = Clock()
    values = {"unit": "steps", "tell": printed.append, "clock": clock} | options
    return PlainLines("train cable-ring", total, **values), printed, clock  # type: ignore[arg-type]


def test_a_line_has_number_note_rate_and_the_time_that_is_left() -> None:
    lines, printed, clock = made()
    assert lines.line() == "train cable-ring: 0 of 4000 steps, 0 s so far", "no rate yet"
    for _ in range(250):
        lines()
    lines.note = "loss 8.81"
    clock.now += 100
    lines.milestone()
    assert printed == [
        "train cable-ring: 250 of 4000 steps, loss 8.81, 2 min so far, 2.5 a second, 25 min left"
    ]
    clock.now += 900
    assert lines.line().endswith("17 min so far, 15 a minute, 4 h 10 min left")
    lines(3750)
    assert lines.line().endswith("done")


def test_what_was_done_before_says_nothing_of_the_rate() -> None:
    lines, _, clock = made(done=3000)
    clock.now += 10
    assert "a second" not in lines.line() and "left" not in lines.line()
    lines(100)
    assert lines.line() == (
        "train cable-ring: 3100 of 4000 steps, 10 s so far, 10 a second, 90 s left"
    )


def test_more_than_the_total_is_no_time_left() -> None:
    """A collection may come to more successes than it asked for."""
    lines, _, clock = made(total=10, unit="episodes")
    clock.now += 5
    lines(12)
    assert lines.line().endswith("12 of 10 episodes, 5 s so far, 2.4 a second, done")


def test_a_line_comes_while_a_single_step_takes_long() -> None:
    heard = threading.Event()
    lines, _, _ = made(tell=lambda line: heard.set())
    with lines.every(0.001):
        assert heard.wait(60), "nothing advanced, and yet it was told of"
    assert not any(thread.name == "progress" for thread in threading.enumerate())


@pytest.mark.parametrize("forced", [{}, {"FORCE_COLOR": "1", "TTY_COMPATIBLE": "1"}])
def test_off_a_terminal_lines_are_plain(
    forced: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where the surroundings ask for colours, as services that build software do."""
    for name, value in forced.items():
        monkeypatch.setenv(name, value)
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    with progress_bar("demo", 3) as advance:
        advance(True)  # a success counts as one
        advance(False)
        advance.milestone()
    said = stream.getvalue()
    assert said.startswith("demo: 1 of 3 episodes") and said.count("\n") == 1
    assert said.isascii() and said.strip().isprintable()


def test_on_a_terminal_there_is_a_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    for term, bar in (("xterm-256color", True), ("dumb", False)):
        stream = Terminal()
        monkeypatch.setenv("TERM", term)
        monkeypatch.setattr(sys, "stderr", stream)
        with progress_bar("demo", 3) as advance:
            advance()
            advance.milestone()
        assert ("\x1b[" in stream.getvalue()) is bar
        assert ("demo: 1 of 3 episodes" in stream.getvalue()) is not bar


def test_nothing_is_said_where_nothing_is_to_be(capsys: pytest.CaptureFixture[str]) -> None:
    with progress_bar("demo", 3, shown=False) as advance:
        advance()
        advance.milestone()
        assert type(advance) is Advance
    assert capsys.readouterr().err == ""


def test_a_part_of_shown_or_hidden_work_is_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    for shown in True, False:
        stream = io.StringIO()
        monkeypatch.setattr(sys, "stderr", stream)
        with progress_bar("eval", 3, shown=shown) as outer:
            with progress_bar("goals", 2) as inner:
                inner.milestone()
            outer.milestone()
        assert stream.getvalue().count("goals") == 0
        assert stream.getvalue().count("eval") == shown
    with progress_bar("goals", 2) as alone:
        assert isinstance(alone, PlainLines), "the turn was given back"


def test_seconds_between_lines() -> None:
    assert progress.EVERY == 30.0
    assert [duration(s) for s in (99.4, 99.6, 3570)] == ["99 s", "2 min", "1 h 0 min"]
