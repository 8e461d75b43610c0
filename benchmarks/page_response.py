"""How soon the page moves after a click, how many frames it draws, and what they cost.

    python benchmarks/page_response.py --busy 2

A demonstrator acts at the page of `warp-deform play`, in headless Chromium, where the processor
draws. Beside it `--busy` processes take what they can get of the cores, as a test suite does. Each
line is one action: `moving_s` is what passes in the page from the press to the first frame of the
motion, `moving_by_driver_s` the same as the browser's driver sees it. Wall times depend on what
else the machine does (`load`); CPU times less so.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from playwright.sync_api import sync_playwright

TASKS = ("cable-ring", "bag-items-1")
TICK = os.sysconf("SC_CLK_TCK")


def cpu(pids: Iterator[int] | list[int]) -> float:
    """CPU seconds of processes so far."""
    total = 0
    for pid in pids:
        try:
            fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        except OSError:  # it has ended
            continue
        total += int(fields[11]) + int(fields[12])
    return total / TICK


def below(pid: int) -> Iterator[int]:
    """Processes that a process started, and theirs."""
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        for child in map(int, task.read_text().split()):
            yield child
            yield from below(child)


def acted(page: Any, server: int, browser: list[int], k: int) -> dict[str, Any]:
    """One action, from the click to where it has been shown."""
    body = page.locator("body")

    def drawn() -> int:
        return int(body.get_attribute("data-drawn"))

    clicked = time.perf_counter()
    server_before = cpu([server])
    page.click("#step")
    page.locator("body[data-playing='true']").wait_for(timeout=120_000, state="attached")
    moving, first, used = time.perf_counter(), drawn(), cpu(browser)
    page.locator(f"body[data-actions='{k}'][data-playing='false']").wait_for(
        timeout=120_000, state="attached"
    )
    seen = time.perf_counter()
    frames = drawn() - first
    waited = float(body.get_attribute("data-waited"))
    return {
        "moving_s": waited,
        "moving_by_driver_s": round(moving - clicked, 3),
        "shown_s": round(seen - moving, 3),
        "frames_per_s": round(frames / (seen - moving), 1),
        "browser_cpu_ms_per_frame": round(1000 * (cpu(browser) - used) / max(frames, 1), 1),
        "server_cores": round((cpu([server]) - server_before) / (seen - clicked), 3),
        "load": round(os.getloadavg()[0], 1),
    }


def measure(task: str, actions: int) -> Iterator[dict[str, Any]]:
    """Rows of a task: each is one action at the speed of the motion."""
    server = subprocess.Popen(
        [sys.executable, "-m", "warp_deform", "play", task], stderr=subprocess.PIPE, text=True
    )
    assert server.stderr is not None
    address = next(found[0] for line in server.stderr if (found := re.search(r"http://\S+", line)))
    try:
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=shutil.which("chromium"))
            page = browser.new_page(viewport={"width": 1280, "height": 720})
            page.goto(address)
            page.locator("body[data-actions='0']").wait_for(timeout=60_000)
            page.select_option("#speed", "1")
            processes = [pid for pid in below(os.getpid()) if pid != server.pid]
            for k in range(1, actions + 1):
                yield acted(page, server.pid, processes, k)
                if page.locator("body").get_attribute("data-over"):
                    break
            browser.close()
    finally:
        server.send_signal(signal.SIGINT)
        server.wait()


def main() -> None:
    """Print a line an action."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--busy", type=int, default=2, help="processes beside it")
    parser.add_argument("--actions", type=int, default=3, help="of each task, at most")
    options = parser.parse_args()
    beside = [
        subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(options.busy)
    ]
    try:
        for task in TASKS:
            for row in measure(task, options.actions):
                print(json.dumps({"task": task, "busy": options.busy, **row}), flush=True)
    finally:
        for process in beside:
            process.kill()


if __name__ == "__main__":
    main()
