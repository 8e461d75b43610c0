"""Read a dataset: its statistics, one episode's arrays, training pairs, a contact sheet.

    warp-deform demo cable-shape -n 10 --out demos
    python examples/read_dataset.py demos --sheet sheet.png

The files are plain Parquet too: `pyarrow.parquet.read_table("demos/episode_000000000.parquet")`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from warp_deform.collecting.inspection import contact_sheet, statistics
from warp_deform.episodes import EpisodeReader
from warp_deform.errors import InputError


def training_pairs(reader: EpisodeReader) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield (color, height, action) of every step, with one row in memory at a time."""
    for seed in reader.seeds:
        for t in range(reader.info(seed).actions):
            step = reader.read_step(seed, t)
            assert step.action is not None
            yield step.color, step.height, step.action


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, help="folder of episode_*.parquet files")
    parser.add_argument("--seed", type=int, help="episode to show; the first when left out")
    parser.add_argument("--sheet", type=Path, metavar="FILE.png", help="write a contact sheet")
    options = parser.parse_args()

    for name, value in statistics(options.folder).items():
        print(f"{name:18} {value}")

    reader = EpisodeReader(options.folder)
    episode = reader.read(reader.seeds[0] if options.seed is None else options.seed)
    print(f"\n{episode.info.task}, seed {episode.info.seed}, by {episode.info.demonstrator}")
    for t, step in enumerate(episode.steps):
        action = "-" if step.action is None else np.array2string(step.action, precision=3)
        print(f"row {t}: score {step.score:.3f}, action {action}, {step.outcome or 'final'}")
    step = episode.steps[0]
    for name in ("color", "height", "particle_q", "body_q", "ground_truth"):
        array = getattr(step, name)
        print(f"{name:12} {array.dtype} {array.shape}")
    if episode.goal is not None:
        print(f"goal         {episode.goal.kind}, targets {episode.goal.targets.shape}")

    actions = np.array([action for _, _, action in training_pairs(reader)]).reshape(-1, 7)
    print(f"\n{len(actions)} training pairs")
    if len(actions):
        distance = np.linalg.norm(actions[:, 3:5] - actions[:, 0:2], axis=1)
        print(f"distance from pick to place: median {np.median(distance):.3f} m")

    if options.sheet is not None:
        contact_sheet(episode, options.sheet)
        print(f"contact sheet: {options.sheet}")


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        sys.exit(f"read_dataset: {error}")
