"""Makes the pictures of the pages.

    python docs/make_page.py docs/images/page.webp
    python docs/make_page.py docs/images/page_policy.webp
    python docs/make_page.py docs/images/operator_page.webp

The first, the README's, loops: a bag is opened, filled and carried. In the second a policy shows
where it looks, and moves the block. The third is what an operator of the arm is asked. The pages
are driven in headless Chromium, where the processor draws them, as finely as a GPU would.
"""

from __future__ import annotations

import contextlib
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from playwright.sync_api import sync_playwright

ROOT = Path(__file__).resolve().parent.parent
POLICY = ROOT / "benchmarks/results/learning/policies/block-notarget-goal-split-100"
FPS, SPEED = 10, 2.0
LOOK_SECONDS, LAST_SECONDS, QUALITY = 1.2, 1.5, 55
SIZE = (488, 800)  # rows and columns [pixels]
WINDOW = {"width": 1280, "height": 780}


@contextlib.contextmanager
def opened(*arguments: str) -> Iterator[Any]:
    """The page of a command, in a browser; edges are smooth, and shadows fall on everything."""
    server = subprocess.Popen(
        [sys.executable, "-m", "warp_deform", *arguments], stderr=subprocess.PIPE, text=True
    )
    assert server.stderr is not None
    address = next(found[0] for line in server.stderr if (found := re.search(r"http://\S+", line)))
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"))
        page = browser.new_page(viewport=WINDOW)
        page.goto(f"{address}?fine")
        yield page
        browser.close()
    server.send_signal(signal.SIGINT)
    server.wait()


def operator(path: Path) -> None:
    """Write what the operator of a simulated arm is asked first."""
    with tempfile.TemporaryDirectory() as folder:
        rig = ["--robot", "sim", "--agent", "scripted", "--seed", "3", "--out", f"{folder}/episode"]
        with opened("franka", "run", *rig, "--page") as page:
            wait(page, "[data-ready='true']")
            picture = shot(page, (585, 960))
    if not cv2.imwrite(str(path), picture, [cv2.IMWRITE_WEBP_QUALITY, 75]):
        sys.exit(f"{path} cannot be written")


def bag(path: Path) -> None:
    """Let the demonstrator of the README's film play its episode."""
    with opened("play", "bag-items-1", "--seed", "6") as page:
        wait(page, "[data-actions='0']")
        page.select_option("#who", "visible")
        page.mouse.move(400, 300)
        page.mouse.wheel(0, -240)
        write(path, play(page, looks=False))


def policy(path: Path) -> None:
    """Let a policy play an episode, and show before every action where it looks."""
    with opened("play", "block-notarget", "--seed", "10000", "--policy", str(POLICY)) as page:
        wait(page, "[data-actions='0']")
        write(path, play(page, looks=True))


def write(path: Path, frames: list[np.ndarray]) -> None:
    """Write a picture that loops."""
    film = cv2.Animation()
    film.frames = frames
    film.durations = np.full(len(frames), 1000 // FPS, np.int32)
    film.durations[-1] = round(1000 * LAST_SECONDS)
    if not cv2.imwriteanimation(str(path), film, [cv2.IMWRITE_WEBP_QUALITY, QUALITY]):
        sys.exit(f"{path} cannot be written")


def play(page: Any, *, looks: bool) -> list[np.ndarray]:
    """Frames of the episode: the motion, and before it where the player looks."""
    page.select_option("#speed", "4")
    page.evaluate("document.getElementById('hint').hidden = true")  # it speaks of a paused motion
    body = page.locator("body")
    frames: list[np.ndarray] = []
    begins, actions = 0.0, 0
    while body.get_attribute("data-over") == "":
        if looks:
            page.click("#look")
            wait(page, "[data-peak][data-waiting='false']")
            frames += [shot(page)] * round(LOOK_SECONDS * FPS)
        page.click("#step")
        actions += 1
        wait(page, f"[data-actions='{actions}'][data-playing='false']")
        page.mouse.move(0, 0)
        ends = float(body.get_attribute("data-end"))
        for time in np.arange(begins, ends, SPEED / FPS):
            drawn = int(body.get_attribute("data-drawn"))
            page.locator("#time").fill(f"{time / ends:.3f}")
            while int(body.get_attribute("data-drawn")) == drawn:
                page.wait_for_timeout(20)
            frames.append(shot(page))
        page.locator("#time").fill("1")
        page.locator("#time").dispatch_event("change")
        begins = ends
    page.wait_for_timeout(500)
    return [*frames, shot(page)]


def wait(page: Any, state: str) -> None:
    """Wait until the page's body has these attributes."""
    page.locator(f"body{state}").wait_for(state="attached", timeout=120_000)


def shot(page: Any, size: tuple[int, int] = SIZE) -> np.ndarray:
    """What the page shows, smaller (H, W, 3) uint8 BGR."""
    page.wait_for_timeout(60)
    picture = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)
    return cv2.resize(picture, size[::-1], interpolation=cv2.INTER_AREA)


if __name__ == "__main__":
    out = Path(sys.argv[1])
    {"page": bag, "page_policy": policy, "operator_page": operator}[out.stem](out)
