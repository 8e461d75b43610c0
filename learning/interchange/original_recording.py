"""One episode as the original DeformableRavens code recorded it, as an episode of this package.

The three RGB-D views of every observation become a colour picture and a height map, by the
original's own arithmetic. What the recording does not say stays empty: particle velocities, state
hashes, simulated time and the ground-truth vector (its beads are rigid bodies with a yaw of their
own, unlike ours). Rigid bodies are `body_q` and fabric vertices `particle_q`, by their numbers in
the recording.

Source: Seita et al., ICRA 2021, and the files that its reference code writes: one folder each for
colour, depth, action and info of T steps, and for what is seen after the last action.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from warp_deform.collecting.recording import GOAL_TARGETS
from warp_deform.episodes import (
    Episode,
    EpisodeInfo,
    Goal,
    Step,
    combine_hashes,
    cpu_fingerprint,
    state_hash,
    versions,
)
from warp_deform.errors import InputError
from warp_deform.rendering.camera import Camera
from warp_deform.rendering.fusion import fuse
from warp_deform.support.quaternion import quat_yaw
from warp_deform.tasks.registry import task as find_task

from .restricted_pickle import read_pickles

__all__ = ["DEMONSTRATOR", "OUTCOME", "PARTS", "read_recording"]

DEMONSTRATOR = "original"
"""Who acted, in imported episodes: the original's scripted demonstrator."""
OUTCOME = "recorded"
"""Outcome of every imported action: the recording does not say."""
PARTS = ("color", "depth", "action", "info", "last_color", "last_depth", "last_info")
"""Folders of a task, each with a file an episode."""

_MOST_SIDE = 1920
_MOST_CAMERAS = 8
# What among a task's recorded extras is our score: a value, or one over another.
_SCORES = {
    "cable-ring": ("fraction", None),
    "cable-ring-notarget": ("fraction", None),
    "cable-shape": ("nb_zone", "nb_beads"),
    "cable-shape-notarget": ("nb_zone", "nb_beads"),
    "cable-line-notarget": ("nb_zone", "nb_beads"),
    "fabric-cover": ("is_item_covered", None),
    "fabric-flat": ("cloth_coverage", None),
    "fabric-flat-notarget": ("cloth_coverage", None),
    "bag-alone-open": ("convex_hull_area", "best_possible_area"),
    "bag-color-goal": ("frac_in_target_bag", None),
}
_DONE = "task.done"
_IN_ZONE = "zone_items_rew", "zone_beads_rew"
"""What bag-items record of a carry: half the shares of items and of beads in the zone."""


def read_recording(source: Path, *, number: int, steps: int, task: str) -> Episode:
    """One episode of the original, of `steps` actions; `task` is our name of the task.

    Raises:
        InputError: a file is missing, damaged, or holds something else.
    """
    paths = [source / part / f"{number:06d}-{steps}.pkl" for part in PARTS]
    color, depth, actions, infos, last_color, last_depth, last_info = read_pickles(paths)
    where = f"{source}: episode {number:06d}-{steps}"
    if not (isinstance(actions, list) and isinstance(infos, list)):
        raise InputError(f"{where} has no lists of actions and infos")
    if {len(actions), len(infos)} != {steps}:
        raise InputError(f"{where} has {len(actions)} actions and {len(infos)} infos")
    try:
        colors = [*_pictures(color, steps, np.uint8), _picture(last_color, np.uint8)]
        depths = [*_pictures(depth, steps, np.float32), _picture(last_depth, np.float32)]
        rows = [_Row.of(info, task) for info in (*infos, last_info)]
        cameras = [_cameras(action, colors[0].shape[1:3]) for action in actions]
        lifts = _lifts(task, rows)
        moves = [[*_action(action), lift] for action, lift in zip(actions, lifts, strict=True)]
        views = zip(colors, depths, [*cameras, cameras[-1]], strict=True)
        maps = [fuse(list(seen), list(far), through) for seen, far, through in views]
        targets = _targets(task, rows[-1])
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        # an InputError is a ValueError, whose text says it all
        said = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
        raise InputError(f"{where} is not in the format of the original: {said}") from error
    made = tuple(
        Step(
            color=maps[t][0],
            height=maps[t][1],
            action=np.array(moves[t]) if t < steps else None,
            score=row.score,
            success=row.done,
            physics_ok=True,
            sim_seconds=0.0,
            state_hash="",
            outcome=OUTCOME if t < steps else None,
            particle_q=row.particle_q,
            particle_qd=np.zeros((0, 3), np.float32),
            body_q=row.body_q,
            body_qd=np.zeros((0, 6), np.float32),
            ground_truth=np.zeros(0, np.float32),
        )
        for t, row in enumerate(rows)
    )
    extra: dict[str, Any] = {
        "original": {"folder": source.name, "episode": number, "extras": [r.extras for r in rows]}
    }
    goal, last = None, made[-1]
    if find_task(task).goal_conditioned:
        if targets is not None:
            extra[GOAL_TARGETS] = targets.tolist()
        # hindsight, as the original trains: the goal is what the episode came to
        known = np.zeros((0, 3)) if targets is None else targets
        goal = Goal(last.color, last.height, known, "demonstrated", number)
    return Episode(_info(task, number, made, extra), made, goal)


def _info(task: str, number: int, steps: tuple[Step, ...], extra: dict[str, Any]) -> EpisodeInfo:
    last = steps[-1]
    return EpisodeInfo(
        task=task,
        seed=number,
        success=last.success,
        score=last.score,
        actions=len(steps) - 1,
        demonstrator=DEMONSTRATOR,
        robot="ur5",
        # tells recordings apart; the steps' own are empty, for nothing was simulated here
        state_hash=combine_hashes(state_hash(s.height, s.particle_q, s.body_q) for s in steps),
        physics_ok=True,
        sim_seconds=0.0,
        discarded_starts=0,
        config={},
        versions=versions(),
        cpu=cpu_fingerprint(),
        goal=None,
        extra=extra,
    )


def _pictures(value: Any, steps: int, dtype: type) -> list[np.ndarray]:
    if not isinstance(value, np.ndarray) or value.ndim < 1 or len(value) != steps:
        raise InputError(f"there are no {steps} observations in colour and depth")
    return [_picture(views, dtype) for views in value]


def _picture(value: Any, dtype: type) -> np.ndarray:
    """The views (cameras, H, W, 3) uint8 or (cameras, H, W) float32 of one observation."""
    axes = 4 if dtype is np.uint8 else 3
    if not isinstance(value, np.ndarray) or value.ndim != axes or value.dtype != dtype:
        raise InputError("an observation has an unknown form")
    if max(value.shape[1:3]) > _MOST_SIDE or len(value) > _MOST_CAMERAS:
        raise InputError(f"an observation has the shape {value.shape}, which is too large")
    return value


def _cameras(action: Mapping[str, Any], size: tuple[int, int]) -> list[Camera]:
    """The cameras that were recorded with an action; all see `size` rows and columns."""
    cameras = []
    for entry in action["camera_config"]:
        if tuple(entry["image_size"]) != tuple(size):
            raise InputError(f"a camera of size {entry['image_size']} for pictures of {size}")
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_quat(_numbers(entry["rotation"], 4)).as_matrix()
        pose[:3, 3] = _numbers(entry["position"], 3)
        intrinsics = _numbers(np.ravel(entry["intrinsics"]), 9).reshape(3, 3)
        cameras.append(Camera(intrinsics, pose, (int(size[0]), int(size[1]))))
    return cameras


def _action(action: Mapping[str, Any]) -> list[float]:
    """Pick x, y [m], yaw [rad], place x, y, yaw."""
    if action["primitive"] != "pick_place":
        raise InputError(f"the action {action['primitive']!r} is no pick_place")
    values: list[float] = []
    for name in ("pose0", "pose1"):
        position, quat_xyzw = action["params"][name]
        yaw = float(quat_yaw(_numbers(quat_xyzw, 4)))
        values += [*_numbers(position, 3)[:2].tolist(), yaw]
    return values


def _lifts(task: str, rows: Sequence[_Row]) -> list[float]:
    """Lift of every action [m]: its task's, or that of the stage that was recorded after it."""
    stages = find_task(task).stages
    if len(stages) == 1:
        return [stages[0].lift] * (len(rows) - 1)
    lifts: dict[Any, float] = {number: stage.lift for number, stage in enumerate(stages, start=1)}
    # an action's stage is chosen with it, and recorded with what it led to
    recorded = [row.extras.get("task_stage") for row in rows[1:]]
    if not set(recorded) <= set(lifts):
        raise InputError(f"the stages of its actions are {recorded}, not among {sorted(lifts)}")
    return [lifts[number] for number in recorded]


@dataclass(frozen=True, eq=False)
class _Row:
    """What an info dict of the original says about a state."""

    body_q: np.ndarray
    particle_q: np.ndarray
    done: bool
    score: float
    extras: dict[str, Any]
    zone_pose: Any
    """Where a fabric's target lay, if it was recorded."""

    @classmethod
    def of(cls, info: Mapping[int | str, Any], task: str) -> _Row:
        bodies: list[np.ndarray] = []
        vertices: list[np.ndarray] = []
        for number in sorted(key for key in info if isinstance(key, int)):
            first, second, *_ = info[number]
            if isinstance(first, int):  # of a fabric: how many vertices, and where they are
                vertices.append(_numbers(np.ravel(second), 3 * first).reshape(-1, 3))
            else:
                bodies.append(np.concatenate([_numbers(first, 3), _numbers(second, 4)]))
        return cls(
            body_q=np.array(bodies, np.float32).reshape(-1, 7),
            particle_q=np.concatenate([np.zeros((0, 3)), *vertices]).astype(np.float32),
            done=_solved(task, info["extras"]),
            score=_score(task, info["extras"]),
            extras=_plain(info["extras"]),
            zone_pose=info.get("sampled_zone_pose"),
        )


def _score(task: str, extras: Mapping[str, Any]) -> float:
    """The score in [0, 1] where it was recorded; else 1 for done and 0 for not done."""
    if task.startswith("bag-items") and all(part in extras for part in _IN_ZONE):
        return sum(float(extras[part]) for part in _IN_ZONE)
    part, whole = _SCORES.get(task, (_DONE, None))
    if part not in extras or (whole is not None and whole not in extras):
        return float(extras[_DONE])
    value = float(extras[part]) / (1.0 if whole is None else float(extras[whole]))
    return min(value, 1.0)  # a stretched cable or bag encloses more than one at rest


def _solved(task: str, extras: Mapping[str, Any]) -> bool:
    """Whether the task is done; of bag-items, which a bead in the zone ends, if it is solved."""
    done = bool(extras[_DONE])
    if task.startswith("bag-items") and all(part in extras for part in _IN_ZONE):
        items, beads = (float(extras[part]) for part in _IN_ZONE)
        return done and items >= 0.5 and beads > 0
    return done


def _targets(task: str, last: _Row) -> np.ndarray | None:
    """What the last state stands for as a goal, see `Task.goal_targets`; None if unknown."""
    if task == "block-notarget" and len(last.body_q) == 1:
        x, y = last.body_q[0, :2].astype(float)
        return np.array([x, y, quat_yaw(last.body_q[0, 3:])])
    if task in ("cable-shape-notarget", "cable-line-notarget") and len(last.body_q) == 24:
        return last.body_q[:, :2].astype(float)
    if task == "fabric-flat-notarget" and last.zone_pose is not None:
        position, quat_xyzw = last.zone_pose
        x, y, _ = _numbers(position, 3)
        yaw = float(quat_yaw(_numbers(quat_xyzw, 4)))
        return np.vstack([[x, y, yaw], last.particle_q]).astype(float)
    return None


def _numbers(value: Any, count: int) -> np.ndarray:
    """`count` finite numbers, float64."""
    numbers = np.asarray(value, dtype=float)
    if numbers.shape != (count,) or not np.isfinite(numbers).all():
        raise InputError(f"{str(value)[:60]} is not {count} finite numbers")
    return numbers


def _plain(value: Any) -> Any:
    """The value in JSON types: arrays as lists, numbers that are not finite as texts."""
    if isinstance(value, Mapping):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | np.ndarray):
        return [_plain(inner) for inner in value]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not np.isfinite(value):
        return str(value)
    return value
