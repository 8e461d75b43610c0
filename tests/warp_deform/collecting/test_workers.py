"""Worker processes: they end with their owner, and leave Ctrl-C to it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

WAITING = """
import os, time
from warp_deform.collecting.workers import Workers

def say(chunk):
    return [os.getpid()]

with Workers(2) as workers:
    print(*{os.getpid(), *workers.run(say, range(20))}, flush=True)
    time.sleep(60)
"""


def gone(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except (FileNotFoundError, ProcessLookupError):
        return True


def test_idle_workers_end_with_an_owner_that_was_killed() -> None:
    owner = subprocess.Popen([sys.executable, "-c", WAITING], stdout=subprocess.PIPE, text=True)
    assert owner.stdout is not None
    pids = {int(pid) for pid in owner.stdout.readline().split()} - {owner.pid}
    assert pids and not any(map(gone, pids))
    owner.kill()
    owner.wait()
    until = time.monotonic() + 20
    while not all(map(gone, pids)):
        assert time.monotonic() < until, "a worker has outlived its owner"
        time.sleep(0.1)


def test_an_interrupted_start_is_one_line(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "warp_deform", "demo", "cable-line-notarget", "-n", "200"]
    process = subprocess.Popen(
        [*command, "--workers", "2", "--out", str(tmp_path)],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # a test runner in the background ignores Ctrl-C, and would hand that on
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    until = time.monotonic() + 120
    while not (tmp_path / "attempts.jsonl").exists():  # from now on workers are started
        assert process.poll() is None and time.monotonic() < until
        time.sleep(0.01)
    time.sleep(0.5)
    os.killpg(process.pid, signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 130, said
    # joblib's resource tracker may add warnings about workers that were still starting
    assert "warp-deform: interrupted; episodes already written are complete, the same" in said
    assert "Traceback" not in said
