"""What an episode holds, and the checks that both the writer and the reader make."""

from __future__ import annotations

import dataclasses
import json
import math
import re
import sys
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import InputError
from ._control_rows import ControlRecord, ControlRow

FORMAT = 1
"""Version of the file format of picks and places."""
CONTROL_FORMAT = 2
"""Version of the file format of control at a fixed rate; this package reads both."""
HEIGHT_UNIT = 1e-5
"""Height of one grey level [m]: 0.01 mm."""
MAX_HEIGHT = 65535 * HEIGHT_UNIT
"""Largest height that a 16-bit image holds [m]."""
MAX_SEED = 999_999_999
MAX_ACTIONS = 4095
MAX_SIDE = 4096
_HEX = re.compile(r"[0-9a-f]*")
_KINDS = ("constructed", "demonstrated")


# The records hold arrays, for which == has no single truth value: they compare by identity.
@dataclass(frozen=True, eq=False)
class Step:
    """One observation and, but for the last, the action taken from it."""

    color: np.ndarray
    """Orthographic colour image, (H, W, 3) uint8 RGB; rows are y, columns x; 320 x 160 usual."""
    height: np.ndarray
    """Height map [m], (H, W) float32 in [0, 0.65535]; stored to 5 um."""
    action: np.ndarray | None
    """Pick x, y, yaw, place x, y, yaw [m, rad], lift [m]: (7,) float64; None in the last row."""
    score: float
    """Task score of the state seen in this row, finite."""
    success: bool
    """Whether the task is solved in this row."""
    physics_ok: bool
    """Whether the solver's guards have held so far."""
    sim_seconds: float
    """Simulated time so far [s]."""
    state_hash: str
    """Hash of the simulated state, lower-case hexadecimal; empty where there is no simulation."""
    outcome: str | None
    """What became of the action, "placed" or "missed" for instance; None in the last row."""
    particle_q: np.ndarray
    """Particle positions [m], (P, 3) float32."""
    particle_qd: np.ndarray
    """Particle velocities [m/s], (P, 3) float32."""
    body_q: np.ndarray
    """Body poses, position [m] and quaternion xyzw, (B, 7) float32."""
    body_qd: np.ndarray
    """Body velocities as Newton holds them, (B, 6) float32."""
    ground_truth: np.ndarray
    """The task's ground-truth vector, (D,) float32."""
    control: ControlRow | None = None
    """Tip, what it holds, and reward, in episodes of control at a fixed rate. Their actions are
    (A,), with numbers from -1 to 1; they have no height maps, and pictures of 0 x 0 where none were
    asked for."""


@dataclass(frozen=True)
class EpisodeInfo:
    """An episode's metadata: JSON in the Parquet schema's metadata under `warp_deform`."""

    task: str
    """Task name, "cable-ring" for instance."""
    seed: int
    """Seed of the episode, 0 to 999,999,999; names the file."""
    success: bool
    """Whether the episode counts as a success."""
    score: float
    """Score that the episode counts with, finite."""
    actions: int
    """Number of actions: one less than the rows."""
    demonstrator: str
    """Who acted: "scripted", "transporter" or "human" for instance."""
    robot: str
    """Robot model, "ur5" or "panda" for instance."""
    state_hash: str
    """Hash of the episode, lower-case hexadecimal."""
    physics_ok: bool
    """Whether the solver's guards held throughout."""
    sim_seconds: float
    """Simulated time [s]."""
    discarded_starts: int
    """Starts that were drawn again: solved already, off the table, or not to be trusted."""
    config: dict[str, Any]
    """The task's full configuration, JSON types."""
    versions: dict[str, Any]
    """See `versions`."""
    cpu: str
    """See `cpu_fingerprint`."""
    goal: dict[str, Any] | None
    """The goal but for its images: kind, seed, shape, targets. The writer fills it in."""
    extra: dict[str, Any]
    """Whatever else the producer records, JSON types."""
    format: int = FORMAT
    """Version of the file format: `FORMAT`, or `CONTROL_FORMAT`."""

    @property
    def control(self) -> ControlRecord | None:
        """How the tip was led, in an episode of control at a fixed rate; else None."""
        return ControlRecord.of(self.extra) if self.format == CONTROL_FORMAT else None


@dataclass(frozen=True, eq=False)
class Goal:
    """What a goal-conditioned task asks for."""

    color: np.ndarray
    """Goal colour image, (H, W, 3) uint8, of the observations' size."""
    height: np.ndarray
    """Goal height map [m], (H, W) float32."""
    targets: np.ndarray
    """Target poses or points as the task defines them, float64 of any shape, finite."""
    kind: str
    """"constructed" (objects placed at the goal) or "demonstrated" (the end of an episode)."""
    seed: int
    """Seed that the goal was made from."""


@dataclass(frozen=True, eq=False)
class Episode:
    """An episode: metadata, one `Step` per row, and the goal of a goal-conditioned task."""

    info: EpisodeInfo
    steps: tuple[Step, ...]
    goal: Goal | None


def check_episode(episode: Episode) -> None:
    """Raise InputError unless the episode can be stored and read back without loss."""
    rows = len(episode.steps)
    if rows != episode.info.actions + 1:
        raise InputError(
            f"the episode has {rows} rows for {episode.info.actions} actions; "
            "it needs one row per action and one for the final observation"
        )
    control = episode.info.control
    size = image_size(episode.steps[0].color, what="row 0: color", control=control)
    for t, step in enumerate(episode.steps):
        check_step(step, t=t, size=size, last=t == rows - 1, control=control)
    if episode.goal is not None:
        tall = size if control is None else (0, 0)
        _check_images(episode.goal.color, episode.goal.height, size, tall, what="goal")


def check_step(
    step: Step, *, t: int, size: tuple[int, int], last: bool, control: ControlRecord | None
) -> None:
    """Raise InputError unless the step fits into row t of images of `size` (H, W)."""
    what = f"row {t}"
    _check_images(step.color, step.height, size, size if control is None else (0, 0), what=what)
    if (control is None) != (step.control is None):
        raise InputError(f"{what}: a tip belongs to episodes of control, and only to them")
    if step.control is not None:
        _check_array(step.control.tip, (4,), np.float64, what=f"{what}: tip")
        if not np.isfinite([*step.control.tip, step.control.reward]).all():
            raise InputError(f"{what}: the tip and the reward must be finite numbers")
    if (step.action is None) != last or (step.outcome is None) != last:
        raise InputError(f"{what}: action and outcome must be None in the last row and only there")
    if step.action is not None:
        width = 7 if control is None else len(control.names)
        _check_array(step.action, (width,), np.float64, what=f"{what}: action")
        if not np.isfinite(step.action).all():
            raise InputError(f"{what}: action {step.action.tolist()} is not finite")
        if control is not None and (np.abs(step.action) > 1).any():
            raise InputError(f"{what}: action {step.action.tolist()} is not within -1 to 1")
    for name, columns in (("particle_q", 3), ("particle_qd", 3), ("body_q", 7), ("body_qd", 6)):
        _check_array(getattr(step, name), (-1, columns), np.float32, what=f"{what}: {name}")
    _check_array(step.ground_truth, (-1,), np.float32, what=f"{what}: ground_truth")
    for name in ("score", "sim_seconds"):
        if not math.isfinite(getattr(step, name)):
            raise InputError(f"{what}: {name} is {getattr(step, name)}, not a finite number")
    if not _HEX.fullmatch(step.state_hash):
        raise InputError(f"{what}: state_hash {step.state_hash!r} is not lower-case hexadecimal")


def image_size(color: np.ndarray, *, what: str, control: ControlRecord | None) -> tuple[int, int]:
    """Return (H, W) of a colour image, each from 1 to 4096; 0, 0 of control without pictures."""
    _check_array(color, (-1, -1, 3), np.uint8, what=what)
    rows, columns = color.shape[:2]
    if control is not None and not control.pictures:
        if (rows, columns) != (0, 0):
            raise InputError(f"{what} is {rows} x {columns}, in an episode without pictures")
        return 0, 0
    if not (1 <= rows <= MAX_SIDE and 1 <= columns <= MAX_SIDE):
        raise InputError(f"{what} is {rows} x {columns}; each side must be 1 to {MAX_SIDE} pixels")
    return rows, columns


def _check_images(
    color: np.ndarray,
    height: np.ndarray,
    size: tuple[int, int],
    tall: tuple[int, int],
    *,
    what: str,
) -> None:
    """Check a colour image of `size` and a height map of the size `tall`."""
    _check_array(color, (*size, 3), np.uint8, what=f"{what}: color")
    _check_array(height, tall, np.float32, what=f"{what}: height")


def _check_array(array: np.ndarray, shape: tuple[int, ...], dtype: type, *, what: str) -> None:
    """Check dtype and shape; -1 stands for any length. No cast: it could lose bits silently."""
    if not isinstance(array, np.ndarray) or array.dtype != dtype:
        actual = array.dtype if isinstance(array, np.ndarray) else type(array).__name__
        raise InputError(f"{what} is {actual}, expected an array of {np.dtype(dtype)}")
    fits = array.ndim == len(shape) and all(
        wanted in (-1, length) for wanted, length in zip(shape, array.shape, strict=True)
    )
    if not fits:
        wanted_text = str(shape).replace("-1", "any")
        raise InputError(f"{what} has shape {array.shape}, expected {wanted_text}")


def info_to_json(info: EpisodeInfo, goal: Goal | None) -> str:
    """Return the metadata as one JSON object with sorted keys, the goal's record filled in."""
    record = {field.name: getattr(info, field.name) for field in dataclasses.fields(info)}
    record["goal"] = _goal_record(info.goal, goal)
    try:
        text = json.dumps(record, default=_plain, allow_nan=False, sort_keys=True)
    except (TypeError, ValueError, RecursionError) as error:
        raise InputError(f"the episode's metadata cannot be written as JSON: {error}") from error
    info_from_json(text)
    return text


def info_from_json(text: str | bytes) -> EpisodeInfo:
    """Return the metadata that `info_to_json` wrote.

    Raises:
        InputError: no JSON object, a key is missing, unknown or of the wrong type, or the format
            is another version's.
    """
    try:
        record = json.loads(text, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise InputError("its metadata is not JSON") from error
    if not isinstance(record, dict) or type(record.get("format")) is not int:
        raise InputError("its metadata names no format version")
    if record["format"] not in (FORMAT, CONTROL_FORMAT):
        advice = "upgrade warp-deform" if record["format"] > CONTROL_FORMAT else "collect it again"
        raise InputError(
            f"it has format version {record['format']}, and this release reads versions {FORMAT} "
            f"and {CONTROL_FORMAT}: {advice}"
        )
    names = {field.name for field in dataclasses.fields(EpisodeInfo)}
    if names != record.keys():
        raise InputError(f"its metadata has wrong or missing keys: {sorted(names ^ record.keys())}")
    for name in ("task", "demonstrator", "robot", "state_hash", "cpu"):
        _check_type(record, name, str)
    for name in ("success", "physics_ok"):
        _check_type(record, name, bool)
    for name in ("config", "versions", "extra"):
        _check_type(record, name, dict)
    limits = {"seed": MAX_SEED, "actions": MAX_ACTIONS, "discarded_starts": MAX_SEED}
    for name, limit in limits.items():
        _check_type(record, name, int)
        if not 0 <= record[name] <= limit:
            raise InputError(f"its metadata has {name} {record[name]}, allowed: 0 to {limit}")
    for name in ("score", "sim_seconds"):
        _check_type(record, name, float)
        record[name] = float(record[name])
    if not record["task"]:
        raise InputError("its metadata has an empty task name")
    if not _HEX.fullmatch(record["state_hash"]):
        raise InputError(f"its metadata has state_hash {record['state_hash']!r}, not hexadecimal")
    if record["goal"] is not None:
        _check_type(record, "goal", dict)
        goal_targets(record["goal"])
    info = EpisodeInfo(**record)
    _ = info.control  # it has to be whole
    return info


def goal_targets(record: dict[str, Any]) -> np.ndarray:
    """Return the targets, float64, of a goal's record; InputError if the record is not whole."""
    _check_type(record, "kind", str)
    _check_type(record, "seed", int)
    _check_type(record, "shape", list)
    _check_type(record, "targets", list)
    if record["kind"] not in _KINDS:
        raise InputError(f"goal kind {record['kind']!r} is unknown; it must be one of {_KINDS}")
    shape, targets = record["shape"], record["targets"]
    if not all(type(x) is float and math.isfinite(x) for x in targets):
        raise InputError("goal targets are not all finite numbers")
    if not all(type(n) is int and n >= 0 for n in shape):
        raise InputError(f"goal shape {str(shape)[:80]} is not a list of lengths")
    try:
        return np.array(targets, dtype=np.float64).reshape(shape)
    except (ValueError, OverflowError) as error:
        raise InputError(
            f"goal shape {str(shape)[:80]} does not fit {len(targets)} targets"
        ) from error


def _goal_record(given: dict[str, Any] | None, goal: Goal | None) -> dict[str, Any] | None:
    if goal is None:
        if given is not None:
            raise InputError("info.goal is set, but the episode has no goal")
        return None
    if not isinstance(goal.targets, np.ndarray) or goal.targets.dtype != np.float64:
        raise InputError("goal targets must be an array of float64")
    if not np.isfinite(goal.targets).all():
        raise InputError("goal targets are not finite")
    record = {
        "kind": goal.kind,
        "seed": goal.seed,
        "shape": list(goal.targets.shape),
        "targets": goal.targets.ravel().tolist(),
    }
    for name in record.keys() & (given or {}).keys():
        if given is not None and given[name] != record[name]:
            raise InputError(f"info.goal has another {name} than the episode's goal")
    return {**(given or {}), **record}


def _check_type(record: dict[str, Any], name: str, kind: type) -> None:
    value = record.get(name)
    # bool is a subclass of int in Python, and JSON writes 1.0 and 1 differently.
    if type(value) is not kind and not (kind is float and type(value) is int):
        raise InputError(f"its metadata has {name} {str(value)[:80]!r}, expected {kind.__name__}")
    # Integers of any size and the infinity that 1e999 reads as.
    if kind is float and not abs(record[name]) <= sys.float_info.max:
        raise InputError(f"its metadata has {name} {str(value)[:80]}, not a finite number")


def _plain(value: Any) -> Any:
    """Turn NumPy scalars and arrays inside configurations into JSON types."""
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is no JSON type")


def _refuse_constant(name: str) -> Any:
    raise ValueError(f"{name} is no JSON number")
