"""Ways to say an action: in metres or normalised, its pick as it stands or drawn to things."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, TypeGuard, get_args

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike

from ..errors import InputError
from ..objects.box import Box
from ..objects.scene_object import SceneObject
from ..robots.primitive import find_grasp
from ..support.checked import real_array
from ..support.quaternion import quat_inverse, quat_rotate
from ..tasks.task import Snapshot, Task
from .spaces import action_space, check_action
from .worlds import Worlds

__all__ = ["Acting", "ActionMode", "reachable", "snapped"]

ActionMode = Literal["metric", "normalized"]
_STEP = float(np.spacing(np.float32(1.0)))
_EDGE = 0.9
"""A pick that is drawn to a box goes this far from its middle to its side at most."""


class Acting:
    """Turns what an agent says into the simulator's action (7,).

    Args:
        mode: "metric" for `action_space()`; "normalized" for a Box (7,) float32 from -1 to 1, which
            is that space scaled
        snap: a pick whose tip would meet nothing moves to the nearest thing that it would take at
            most so far away [m]; 0: none does

    Raises:
        InputError: there is no such mode, or `snap` is no distance, or the task has a jaw, whose
            picks are not drawn.
    """

    def __init__(self, worlds: Worlds, mode: str, snap: float) -> None:
        if mode not in get_args(ActionMode):
            known = ", ".join(get_args(ActionMode))
            raise InputError(f"action_mode is one of {known}, not {mode!r}")
        if isinstance(snap, bool) or not isinstance(snap, int | float) or not snap >= 0:
            raise InputError(f"snap is a distance in metres, 0 or more, not {snap!r}")
        if snap and worlds.task.jaw is not None:
            raise InputError(f"{worlds.task.name} is played with a jaw: leave out snap")
        self._worlds, self.mode, self.snap = worlds, mode, float(snap)
        self._metric = action_space()
        self.space = (
            self._metric if mode == "metric" else spaces.Box(-1.0, 1.0, (7,), dtype=np.float32)
        )

    def of(self, action: ArrayLike, *, name: str = "action") -> np.ndarray:
        """The simulator's action (7,); its pick stays where it is, see `drawn`.

        Raises:
            InputError: the action is not in `space`.
        """
        return check_action(self._metres(action, name), name=name)

    def drawn(self, slot: int, action: np.ndarray) -> np.ndarray:
        """The same action with its pick where the tip takes something, if it is near enough."""
        if not self.snap:
            return action
        return snapped(action, self._worlds.task, self._worlds.episodes[slot].snapshot, self.snap)

    def shift(self, said: np.ndarray, drawn: np.ndarray) -> dict[str, float]:
        """What infos tell of a pick that was drawn: `pick_shift` [m]; nothing without `snap`."""
        moved = float(np.linalg.norm(drawn[:2] - said[:2]))
        return {"pick_shift": moved} if self.snap else {}

    def said(self, action: np.ndarray) -> np.ndarray:
        """An action (7,) of the simulator as an agent of this mode would say it."""
        if self.mode == "metric":
            return action
        low, high = self._metric.low, self._metric.high
        return (2 * (action - low) / (high - low) - 1).astype(np.float32)

    def _metres(self, action: ArrayLike, name: str) -> ArrayLike:
        if self.mode == "metric":
            return action
        values = real_array(action, (7,), name=name)
        if not (np.abs(values) <= 1 + _STEP).all():  # also when one is not a number
            raise InputError(f"{name}: {values} is not within -1 to 1, as normalised actions are")
        low, high = self._metric.low, self._metric.high
        return low + (np.clip(values, -1, 1) + 1) / 2 * (high - low)


def reachable(action: np.ndarray | None) -> TypeGuard[np.ndarray]:
    """Whether there is an action, and it is in the simulator's action space."""
    return action is not None and bool(action_space().contains(action))


def snapped(action: np.ndarray, task: Task, snapshot: Snapshot, within: float) -> np.ndarray:
    """`action` (7,) with its pick moved by at most `within` [m] to where a tip takes something.

    It is returned as it is where the tip takes something anyway, or nothing is near enough.
    """

    def takes(xy: np.ndarray) -> bool:
        at = np.array([*xy, action[2]])
        q, bodies = snapshot.particle_q, snapshot.body_q
        return find_grasp(at, snapshot.objects, q, bodies, task.primitive) is not None

    if takes(action[:2]):
        return action
    spots = _spots(action[:2], snapshot.objects, snapshot)
    low, high = action_space().low[:2], action_space().high[:2]
    spots = spots[((spots >= low) & (spots <= high)).all(axis=1)]
    away = np.linalg.norm(spots - action[:2], axis=1)
    for k in np.argsort(away, kind="stable"):
        if away[k] > within:
            break
        if takes(spots[k]):
            return np.concatenate([spots[k], action[2:]])
    return action


def _spots(xy: np.ndarray, objects: Sequence[SceneObject], snapshot: Snapshot) -> np.ndarray:
    """Where (n, 2) [m] a tip may take something: every particle, and the nearest of every box."""
    spots = [snapshot.particle_q[:, :2].astype(float)]
    for item in objects:
        if not isinstance(item, Box):
            continue
        pose = snapshot.body_q[item.body].astype(float)
        back = quat_inverse(pose[3:])
        for part in item.config.parts:
            middle = pose[:3] + quat_rotate(pose[3:], np.array(part.offset, dtype=float))
            local = quat_rotate(back, np.array([*xy, middle[2]]) - middle)
            half = _EDGE * np.array(part.size) / 2
            near = middle + quat_rotate(pose[3:], np.clip(local, -half, half))
            spots.append(near[None, :2])
    return np.concatenate(spots)
