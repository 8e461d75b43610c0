"""The operator's terminal: what is asked, what counts as an answer, and what is shown."""

from __future__ import annotations

import os
import pty
import select
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fixtures.franka_arm import FAR, Arm, Person, episode
from fixtures.franka_episodes import ACTION, GOAL

from hardware.cameras.camera import read_image
from hardware.choosers.human import TerminalOperator
from hardware.episodes.episode import EpisodeConfig
from hardware.episodes.operators import Answer, Proposal
from hardware.recordings.recording import Recording
from hardware.vision.overlay import draw_action

PROPOSAL = Proposal(ACTION, {}, None, 1)


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
        assert TerminalOperator().confirm(PROPOSAL) is Answer.STOP
        os.write(keyboard, b"\n")
        assert select.select([screen], [], [], 10.0)[0]
        assert TerminalOperator().wait("lay the board flat") is False


def test_answers_through_a_pipe_are_all_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """A script answers in advance; the end of its input stops."""
    out, into = os.pipe()
    os.write(into, b"s\n\n")
    os.close(into)
    with os.fdopen(out) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        said = [TerminalOperator().confirm(PROPOSAL) for _ in range(3)]
    assert said == [Answer.SKIP, Answer.DO, Answer.STOP]


class Viewer(Person):
    """Looks at the picture of every plan."""

    def __init__(self, *answers: Answer) -> None:
        super().__init__(*answers)
        self.files, self.pictures = list[Path | None](), list[np.ndarray]()

    def confirm(self, proposal: Proposal) -> Answer:
        assert proposal.picture is not None
        self.files.append(proposal.picture)
        self.pictures.append(read_image(proposal.picture, color=True))
        assert (self.pictures[-1] == proposal.overlay).all()
        return super().confirm(proposal)


def test_the_overlay_is_of_the_plan_that_is_asked_for_and_stays_that_of_the_one_done(
    tmp_path: Path,
) -> None:
    other = replace(ACTION, place_xy=(0.4, -0.1))
    last = replace(ACTION, place_xy=(0.4, 0.1))
    viewer = Viewer(Answer.SKIP, Answer.DO, Answer.STOP)
    result, _ = episode(tmp_path / "a", Arm(), [FAR, ACTION, other, last], operator=viewer)
    assert result.outcomes == ("placed",)
    frames = tmp_path / "a" / "frames"
    assert viewer.files == [frames / f"00{i}_overlay.png" for i in (0, 0, 1)]
    kept = [read_image(frames / f"00{i}_overlay.png", color=True) for i in (0, 1)]
    np.testing.assert_array_equal(kept[0], viewer.pictures[1])
    assert (viewer.pictures[0] != viewer.pictures[1]).any()
    # stopped: of no plan, as if nothing had been proposed
    seen = Recording.read(tmp_path / "a")
    plain = draw_action(seen.view(1), EpisodeConfig().view, mask=seen.mask(1), goal=GOAL)
    np.testing.assert_array_equal(kept[1], plain)


def test_the_prompt_names_the_picture(tmp_path: Path) -> None:
    asked: list[str] = []
    terminal = TerminalOperator(lambda text: asked.append(text) or "")
    terminal.confirm(replace(PROPOSAL, picture=tmp_path / "000_overlay.png"))
    assert str(tmp_path / "000_overlay.png") in asked[0]
