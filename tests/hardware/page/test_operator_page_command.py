"""`warp-deform franka ... --page`: the flags, and who is asked."""

from __future__ import annotations

import json
import signal
import threading
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


@pytest.fixture
def person(monkeypatch):
    """Answers at the page of whatever command is started, from a list; keeps what was asked."""
    answers: list[str] = []
    asked: list[str] = []
    threads: list[threading.Thread] = []

    def attend(operator):
        server = PageServer(operator._session, operator._served)

        def act():
            with server.tab() as tab:
                for says in answers:
                    now = question(tab)
                    asked.append(now["which"])
                    answer(tab, now, says)
                asked.append(hear(tab, "over")["text"])

        threads.append(threading.Thread(target=act, daemon=True))
        threads[-1].start()

    monkeypatch.setattr(PageOperator, "announce", attend)
    yield answers, asked
    for thread in threads:
        thread.join(10)
        assert not thread.is_alive()


def test_a_plan_and_a_goal_are_asked_for_at_the_page(
    person, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    answers, asked = person
    answers += ["another", "yes"]
    out = tmp_path / "episode"
    words = ["run", "--agent", "random", "--seed", "3", "--out", str(out), "--page", "--json"]
    assert main(["franka", *words]) == 0
    assert json.loads(capfd.readouterr().out.splitlines()[-1])["actions"] == 1
    assert asked[:2] == ["plan", "plan"] and "recorded in" in asked[2]

    answers[:], asked[:] = ["another", "stop"], []
    goal = tmp_path / "goal.png"
    words = ["capture-goal", "--robot", "sim", "--seed", "5", "--out", str(goal), "--page"]
    assert main(["franka", *words]) == 2
    assert "nothing was written" in capfd.readouterr().err and not goal.exists()
    answers[:], asked[:] = ["yes"], []
    assert main(["franka", *words]) == 0 and goal.is_file()
    assert asked[0] == "keep" and "px of cable" in asked[1]


@pytest.mark.parametrize("flag", [["--port", "8000"], ["--browser"]])
def test_flags_of_the_page_need_the_page(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], flag: list[str]
) -> None:
    assert main(["franka", "run", "--out", str(tmp_path / "e"), *flag]) == 2
    assert "give --page" in capfd.readouterr().err and not (tmp_path / "e").exists()
