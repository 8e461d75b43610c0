"""The operator's terminal: what is asked, what counts as an answer, and what is shown."""

from __future__ import annotations

import os
import pty
import select
import sys

import pytest
from franka_episodes import ACTION

from hardware.human import Terminal
from hardware.operators import Answer, Plan

PLAN = Plan(ACTION, {}, None, 1)


class Answering:
    """Stands for stderr; types `answer` as soon as a question is shown."""

    def __init__(self, keyboard: int, answer: bytes) -> None:
        self.keyboard, self.answer, self.shown = keyboard, answer, ""

    def write(self, text: str) -> int:
        self.shown += text
        if text.endswith("> "):
            os.write(self.keyboard, self.answer)
        return len(text)

    def flush(self) -> None:
        pass


def test_what_was_typed_before_the_question_is_no_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    keyboard, screen = pty.openpty()
    with os.fdopen(keyboard, "wb", buffering=0), os.fdopen(screen, "r") as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        os.write(keyboard, b"\n\n")
        assert select.select([screen], [], [], 10.0)[0]
        monkeypatch.setattr(sys, "stderr", Answering(keyboard, b"q\n"))
        assert Terminal().confirm(PLAN) is Answer.STOP
        os.write(keyboard, b"\n")
        assert select.select([screen], [], [], 10.0)[0]
        assert Terminal().wait("lay the board flat") is False


def test_answers_through_a_pipe_are_all_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """A script answers in advance; the end of its input stops."""
    out, into = os.pipe()
    os.write(into, b"s\n\n")
    os.close(into)
    with os.fdopen(out) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        said = [Terminal().confirm(PLAN) for _ in range(3)]
    assert said == [Answer.SKIP, Answer.DO, Answer.STOP]
