"""`franka emulate` and `franka run --page` as two commands, and a person at the page who stops."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from fixtures.operator_desk import answer, question, say
from fixtures.places import ROOT
from websockets.sync.client import connect

pytestmark = [pytest.mark.emulator, pytest.mark.timeout(240)]
HOST = "127.0.78.5"


@contextmanager
def command(*arguments: object) -> Iterator[subprocess.Popen[str]]:
    """A command of its own, which is not left behind."""
    running = subprocess.Popen(
        [sys.executable, "-m", "warp_deform", "franka", *map(str, arguments)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
    )
    watchdog = threading.Timer(200.0, running.kill)
    watchdog.start()
    try:
        yield running
    finally:
        watchdog.cancel()
        running.kill()
        running.communicate()


def first_line(running: subprocess.Popen[str]) -> str:
    assert running.stderr is not None
    return running.stderr.readline()


def test_a_stop_at_the_page_ends_the_command_that_moves_an_arm_of_another(tmp_path: Path) -> None:
    out = tmp_path / "episode"
    with command("emulate", "--host", HOST, "--chain", 0) as emulator:
        assert f"serves {HOST}" in first_line(emulator)
        with command(
            "run", "--robot", "panda", "--host", HOST, "--camera", "sim", "--execute", "--page",
            "--agent", "random", "--max-actions", 1, "--out", out,
        ) as run:  # fmt: skip
            address = first_line(run).split()[1]
            with connect(
                address.replace("http", "ws", 1) + "ws",
                origin=address.rsplit("/", 2)[0], compression=None, max_size=2**26,
            ) as tab:  # fmt: skip
                asked = question(tab)
                assert "action" not in (out / "steps.jsonl").read_text()
                answer(tab, asked, "yes")
                while '"plan"' not in (out / "steps.jsonl").read_text():
                    time.sleep(0.01)  # from here on the arm moves
                say(tab, do="halt")
            _, errors = run.communicate()
        assert run.returncode == 130, errors
        assert emulator.poll() is None  # it serves on
        emulator.send_signal(signal.SIGINT)
        assert emulator.wait(60) == 0
    assert "interrupted" in errors
    assert json.loads((out / "episode.json").read_text())["outcome"] == "stopped"
    kinds = {json.loads(line)["kind"] for line in (out / "steps.jsonl").read_text().splitlines()}
    assert kinds == {"observation", "plan"}, "it was stopped before the action was over"
