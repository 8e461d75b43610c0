"""What refining does to trajectories at 20 Hz: its measures before and after, a row a folder.

    python benchmarks/trajectories.py FOLDER... [--out FILE]

Folders are what `warp-deform refine DIR --trajectories` has written. One row each, appended to the
results: the task, the search, episodes, those that were improved, and before and after the control
steps of all, the mean loss [m] and the mean roughness, and how many are not solved at rest.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from learning.refinement.refine import REFINEMENT
from warp_deform.episodes import EpisodeReader


def main() -> None:
    """Read folders, and append rows."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/trajectories.jsonl"))
    options = parser.parse_args()
    for folder in options.folders:
        with options.out.open("a") as file:
            file.write(json.dumps(row(folder)) + "\n")


def row(folder: Path) -> dict[str, Any]:
    """The measures of a folder."""
    infos = EpisodeReader(folder, control=True).infos()
    stories = [info.extra[REFINEMENT] for info in infos]
    told: dict[str, Any] = {
        "task": infos[0].task,
        "method": stories[0]["method"],
        "evaluations": stories[0]["evaluations"],
        "episodes": len(stories),
        "improved": sum(story["improved"] for story in stories),
    }
    for when in ("before", "after"):
        each = [story[when] for story in stories]
        told[f"steps_{when}"] = sum(one["steps"] for one in each)
        told[f"loss_{when}"] = float(np.mean([one["loss"] for one in each]))
        told[f"roughness_{when}"] = float(np.mean([one["roughness"] for one in each]))
        told[f"unrested_{when}"] = sum(not one["solved"] for one in each)
    return told


if __name__ == "__main__":
    main()
