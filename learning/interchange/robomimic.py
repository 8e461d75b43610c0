"""Episodes as one robomimic HDF5 file.

A demonstration has T samples: `obs` before and `next_obs` after every action, so the final
observation is kept. `states` is the simulator's state in one row: particle positions and
velocities, then body poses and velocities, see the attribute `state_layout`. A reward is what the
action added to the score, as in the Gymnasium environments.

Source: the dataset format in robomimic's documentation (Mandlekar et al., CoRL 2021).
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from warp_deform import __version__
from warp_deform.episodes import Episode, EpisodeReader, Step
from warp_deform.episodes.corrected import refuse_corrected
from warp_deform.errors import InputError
from warp_deform.support.extras import install_extra
from warp_deform.support.progress import progress_bar
from warp_deform.tasks.registration import env_id
from warp_deform.tasks.registry import is_known

from .conversion import ConversionReport, new_file, size_of

__all__ = ["STATE_PARTS", "VALIDATION_EVERY", "export_robomimic"]

STATE_PARTS = ("particle_q", "particle_qd", "body_q", "body_qd")
"""What a row of `states` is made of, in this order."""
VALIDATION_EVERY = 10
"""Every tenth demonstration, or the last of fewer, is in the mask `valid`, others in `train`."""

_GYM = 2  # robomimic's EnvType.GYM_TYPE


def export_robomimic(source: Path, target: Path) -> ConversionReport:
    """Write the episodes of folder `source` as the file `target`, whose name ends with .hdf5.

    Raises:
        InputError: h5py is not installed, `source` has no episodes or has those of several tasks
            or kinds, one has no action, or `target` exists.
    """
    began = time.perf_counter()
    try:
        import h5py
    except ImportError as error:
        raise InputError(
            f"h5py is not installed; in the clone run: {install_extra('export')}"
        ) from error
    target = Path(target)
    if target.suffix not in (".hdf5", ".h5"):
        raise InputError(f"{target} must end with .hdf5: robomimic keeps a dataset in one file")
    reader = EpisodeReader(source)
    refuse_corrected(reader.infos(), folder=source, advice="this format has no place for labels")
    task = reader.info(reader.seeds[0]).task
    total = 0
    first: dict[str, tuple[int, ...]] = {}
    with new_file(target) as partial, progress_bar("robomimic", len(reader)) as advance:
        with h5py.File(partial, "x") as file:
            data = file.create_group("data")
            for number, episode in enumerate(reader):
                if episode.info.task != task:
                    raise InputError(
                        f"{source} holds episodes of {task} and of {episode.info.task}; "
                        "convert one task at a time"
                    )
                group = data.create_group(f"demo_{number}")
                _write_demonstration(group, episode)
                layout = {key: array.shape[1:] for key, array in group["obs"].items()}
                first = first or layout
                if layout != first:
                    raise InputError(
                        f"the episode of seed {episode.info.seed} differs from the first one in "
                        "images, goal or ground truth; convert episodes of one kind at a time"
                    )
                total += episode.info.actions
                advance()
            data.attrs["total"] = total
            data.attrs["env_args"] = json.dumps(_env_args(task))
            data.attrs["warp_deform"] = __version__
            names = [f"demo_{number}" for number in range(len(reader))]
            for mask, chosen in _masks(names).items():
                file[f"mask/{mask}"] = np.array(chosen, dtype="S")
    return ConversionReport(
        format="robomimic",
        out=target,
        task=task,
        episodes=len(reader),
        steps=total,
        bytes=size_of(target),
        seconds=time.perf_counter() - began,
    )


def _write_demonstration(group: Any, episode: Episode) -> None:
    info, steps = episode.info, episode.steps
    if info.actions == 0:
        raise InputError(
            f"the episode of seed {info.seed} has no action, and robomimic needs one; convert "
            "demonstrations"
        )
    group.attrs["num_samples"] = info.actions
    group.attrs["seed"] = info.seed
    group.attrs["info"] = json.dumps(asdict(info), sort_keys=True)
    layout = {name: list(getattr(steps[0], name).shape) for name in STATE_PARTS}
    group.attrs["state_layout"] = json.dumps(layout)
    actions = np.stack([step.action for step in steps[:-1] if step.action is not None])
    group["actions"] = actions
    group["rewards"] = np.diff([step.score for step in steps])
    group["dones"] = (np.arange(info.actions) == info.actions - 1).astype(np.int64)
    group["states"] = _states(steps[:-1], seed=info.seed)
    for name, seen in (("obs", steps[:-1]), ("next_obs", steps[1:])):
        for key, values in _observations(episode, seen).items():
            # a chunk a sample: robomimic reads samples
            group.create_dataset(
                f"{name}/{key}",
                data=values,
                chunks=(1, *values.shape[1:]),
                compression="gzip",
                compression_opts=1,
                shuffle=values.dtype != np.uint8,
            )


def _states(steps: Sequence[Step], *, seed: int) -> np.ndarray:
    """Rows (T, n) float32."""
    rows = [np.concatenate([getattr(step, part).ravel() for part in STATE_PARTS]) for step in steps]
    if len({len(row) for row in rows}) > 1:
        raise InputError(f"the episode of seed {seed} has states of several sizes")
    return np.stack(rows)


def _observations(episode: Episode, steps: Sequence[Step]) -> dict[str, np.ndarray]:
    """By name: images (T, H, W, 3) uint8, heights (T, H, W, 1) float32 [m], ground truth."""
    values = {
        "color": np.stack([step.color for step in steps]),
        "height": np.stack([step.height for step in steps])[..., None],
    }
    if episode.goal is not None:
        values["goal_color"] = np.stack([episode.goal.color] * len(steps))
        values["goal_height"] = np.stack([episode.goal.height] * len(steps))[..., None]
    if steps[0].ground_truth.size:
        values["ground_truth"] = np.stack([step.ground_truth for step in steps])
    return values


def _env_args(task: str) -> dict[str, Any]:
    # real recordings name tasks of their own, which have no environment
    name = env_id(task) if is_known(task) else task
    return {"env_name": name, "type": _GYM, "env_version": __version__, "env_kwargs": {}}


def _masks(names: list[str]) -> dict[str, list[str]]:
    if len(names) == 1:
        return {"train": names}
    valid = names[VALIDATION_EVERY - 1 :: VALIDATION_EVERY] or names[-1:]
    return {"train": [name for name in names if name not in set(valid)], "valid": valid}
