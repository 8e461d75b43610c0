"""`warp-deform franka ... --page`: the flags, and who is asked."""

from __future__ import annotations

import json
import signal
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from fixtures.operator_desk import answer, question
from fixtures.page_server import PageServer, hear

from hardware.command.rig_options import interruptible
from hardware.page.operator import PageOperator
from warp_deform.command.main import main


def test_stop_reaches_a_program_that_was_started_deaf_to_interrupts():
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # as what a script starts behind itself
    try:
        with pytest.raises(KeyboardInterrupt), interruptible():
            signal.raise_signal(signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)
    with interruptible():
        assert signal.getsignal(signal.SIGINT) is before


class Person:
    """Answers at the page of whatever command is started, from a list."""

    def __init__(self) -> None:
        self._answers: list[str] = []
        self._asked: list[str] = []
        self._threads: list[threading.Thread] = []

    def answers(self, *says: str) -> None:
        """What will be said next."""
        self._answers, self._asked = list(says), []

    def heard(self) -> list[str]:
        """What was asked and how it ended; a command may end before its last word is read."""
        while self._threads:
            self._threads[-1].join(30)
            assert not self._threads.pop().is_alive()
        return self._asked

    def attend(self, operator: PageOperator) -> None:
        """Sit down at the page of this operator."""
        server = PageServer(operator._session, operator._served)
        answers, asked = self._answers, self._asked

        def act() -> None:
            with server.tab() as tab:
                for says in answers:
                    now = question(tab)
                    asked.append(now["which"])
                    answer(tab, now, says)
                asked.append(hear(tab, "over")["text"])

        self._threads.append(threading.Thread(target=act, daemon=True))
        self._threads[-1].start()


@pytest.fixture
def person(monkeypatch: pytest.MonkeyPatch) -> Iterator[Person]:
    somebody = Person()
    monkeypatch.setattr(PageOperator, "announce", lambda operator: somebody.attend(operator))
    yield somebody
    somebody.heard()


def test_a_plan_and_a_goal_are_asked_for_at_the_page(
    person: Person, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    person.answers("another", "yes")
    out = tmp_path / "episode"
    words = ["run", "--agent", "random", "--seed", "3", "--out", str(out), "--page", "--json"]
    assert main(["franka", *words]) == 0
    assert json.loads(capfd.readouterr().out.splitlines()[-1])["actions"] == 1
    asked = person.heard()
    assert asked[:2] == ["plan", "plan"] and "recorded in" in asked[2]

    person.answers("another", "stop")
    goal = tmp_path / "goal.png"
    words = ["capture-goal", "--robot", "sim", "--seed", "5", "--out", str(goal), "--page"]
    assert main(["franka", *words]) == 2
    assert "nothing was written" in capfd.readouterr().err and not goal.exists()
    assert person.heard()[:2] == ["keep", "keep"]
    person.answers("yes")
    assert main(["franka", *words]) == 0 and goal.is_file()
    asked = person.heard()
    assert asked[0] == "keep" and "px of cable" in asked[1]


@pytest.mark.parametrize("flag", [["--port", "8000"], ["--browser"]])
def test_flags_of_the_page_need_the_page(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], flag: list[str]
) -> None:
    assert main(["franka", "run", "--out", str(tmp_path / "e"), *flag]) == 2
    assert "give --page" in capfd.readouterr().err and not (tmp_path / "e").exists()
