"""CPU time of an episode's film, against the same film with every frame drawn whole.

    python benchmarks/films.py --out benchmarks/results/films.jsonl

Collects one demonstration a task, films it by `warp_deform.collecting.video.film` (simulation,
drawing, captions, encoder), once to compile and then `--repeats` times, and prints CPU time of the
process and its encoder: the least of the repeats, as other work on the machine only adds. `--whole`
also times frames that forget the one before. Rows are appended, with the commit measured; that of
581dce6 comes from this script in a worktree of that commit, with its names of the modules.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imageio_ffmpeg

from warp_deform.collecting import video as filming
from warp_deform.collecting.collect import CollectConfig, collect
from warp_deform.collecting.workers import single_threaded
from warp_deform.rendering.scene_view import SceneView


class Whole(SceneView):
    """Frames that do not go on from the one before."""

    def render(self, *arguments: Any, **options: Any) -> Any:
        """The frame, drawn whole."""
        self.forget()
        return super().render(*arguments, **options)


def cpu() -> tuple[float, float]:
    """CPU time of this process and of its ended children [s]."""
    used = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    own, children = (each.ru_utime + each.ru_stime for each in used)
    return own, children


def timed(job: Callable[[], object], repeats: int) -> tuple[float, float]:
    """CPU time of `job`, and its children's share [s]: those of the quickest of `repeats`."""
    costs = []
    for _ in range(repeats):
        own, children = cpu()
        job()
        ends = cpu()
        costs.append((ends[0] - own + ends[1] - children, ends[1] - children))
    return min(costs)


def measure(task: str, *, repeats: int, whole: bool, folder: Path) -> dict[str, Any]:
    """A row of results: times [ms] a frame, sizes, ratios."""
    demos, path = folder / "demos", folder / "film.mp4"
    collect(CollectConfig(task=task, episodes=1, out=demos, workers=1))
    with single_threaded():
        filming.film(demos, path)
        total, encoder = timed(lambda: filming.film(demos, path), repeats)
        frames = imageio_ffmpeg.count_frames_and_secs(str(path))[0]
        row = {
            "task": task,
            "frames": frames,
            "film_cpu_s": total,
            "ms_a_frame": 1e3 * total / frames,
            "encoder_ms_a_frame": 1e3 * encoder / frames,
            "megabytes": path.stat().st_size / 1e6,
        }
        if whole:
            drawn, filming.SceneView = filming.SceneView, Whole
            try:
                slow, _ = timed(lambda: filming.film(demos, path), repeats)
            finally:
                filming.SceneView = drawn
            row |= {"whole_ms_a_frame": 1e3 * slow / frames, "whole_ratio": slow / total}
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--tasks", nargs="+", default=["cable-shape", "fabric-cover", "bag-items-1"]
    )
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--whole", action="store_true", help="also with every frame drawn whole")
    parser.add_argument("--out", type=Path, help="append rows to this file")
    options = parser.parse_args()
    revision = ["git", "describe", "--always", "--dirty", "--abbrev=7"]
    commit = subprocess.run(revision, capture_output=True, text=True, check=True).stdout.strip()
    for task in options.tasks:
        with tempfile.TemporaryDirectory() as folder:
            row = measure(task, repeats=options.repeats, whole=options.whole, folder=Path(folder))
        row = {"commit": commit, "day": time.strftime("%Y-%m-%d"), **row}
        print(json.dumps(row))
        if options.out:
            with options.out.open("a") as file:
                file.write(json.dumps(row) + "\n")


if __name__ == "__main__":
    main()
