"""The test of a control run: its chosen snapshot plays the test seeds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from warp_deform.control.tensor_worlds import TensorControlWorlds
from warp_deform.errors import InputError
from warp_deform.support.progress import progress_bar

from ..evaluation.protocol import FIRST_SEED
from ..runs.folder import write_json
from ..training.processes import join_processes
from .film import film_played
from .play import play_control
from .run import ControlRun
from .saved import load_actor

__all__ = ["evaluate_control"]

_FILMED = 2
"""Episodes of a video."""


def evaluate_control(
    folder: Path,
    *,
    episodes: int = 200,
    step: int | None = None,
    video: Path | None = None,
    progress: bool = True,
) -> dict[str, Any]:
    """Play test seeds with a run's chosen snapshot; what it came to, also kept in the folder.

    Args:
        episodes: with seeds 10,000 and up
        step: of another snapshot than the chosen one; the folder then keeps nothing
        video: an MP4 of the first two episodes; it is written first

    Returns:
        task, method, seed, updates, selected, validation: of that snapshot, first_seed, test: see
        `PlayedControl.summary`, and left and scores, episode by episode; left is None where a guard
        has fired

    Raises:
        InputError: this is no control run's folder, it has no such snapshot, or the video's path
            does not end with .mp4 or cannot be written.
    """
    run = ControlRun(folder)
    settings, chosen = run.read_control(), run.chosen() if step is None else step
    if chosen not in run.steps():
        raise InputError(f"{folder} has no snapshot of step {chosen}; it has {run.steps()}")
    control, first = settings["control"], FIRST_SEED["test"]
    actor, task = load_actor(run.snapshot(chosen))
    if video is not None:
        seeds = range(first, first + min(episodes, _FILMED))
        film_played(video, actor, task, seeds=seeds, horizon=control["horizon"])
    bar = progress_bar(f"test {task}", episodes, shown=progress)
    with join_processes("cpu", threads=1), bar as advance:
        worlds = TensorControlWorlds(
            task, control["worlds"], start="held", horizon=control["horizon"], action_penalty=0.0
        )
        played = play_control(worlds, actor, range(first, first + episodes), advance=advance)
    report = {
        "task": task,
        "method": control["method"],
        "seed": control["seed"],
        "updates": settings["plan"]["updates"],
        "selected": chosen,
        "validation": run.validated().get(chosen),
        "first_seed": first,
        "test": played.summary(),
        "left": [float(each) if each < float("inf") else None for each in played.left],
        "scores": played.scores.tolist(),
    }
    if step is None:
        write_json(run.report, report)
    return report
