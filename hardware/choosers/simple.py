"""The choosers `policy`, `random` and `scripted`.

Actions are in the base frame. What was missed, refused or skipped is not proposed again until
something is brought elsewhere. The others stand in `hardware.choosers.planner` and
`hardware.choosers.human`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import chain
from pathlib import Path

import cv2
import numpy as np

from warp_deform.errors import InputError
from warp_deform.tasks.cable_mask_goal import CableMaskGoal
from warp_deform.tasks.strand_grasp import find_strand_grasp, map_direction
from warp_deform.tasks.task import Layout, Snapshot

from ..arm.pick_place import PickPlaceAction, PickPlaceOutcome
from ..episodes.episode import Observation
from ..twin.twin import TwinLook
from ..vision.task_frame import PIXEL_RATIO, fits_task, to_base
from ..vision.top_down_view import TopDownView
from .finger_clearance import has_finger_clearance

__all__ = [
    "FailedPicks",
    "PolicyChooser",
    "RandomChooser",
    "ScriptedChooser",
    "tangent_at",
    "to_action",
]

_SHIFTED = 0.01
"""A cable has moved if more of it than this share lies beside where it lay, or the other way
round: a chain of 45 cm that was drawn along itself by 1 cm has."""
_NEAR = 0.008
"""Picks this close to one that failed are the same one [m]: the paper's pixels are 1.9 mm."""
_TWO_PICTURES = 2
_MOST_PROPOSALS = 8
"""Picks that are looked at for finger clearance; where none of them has it, the first is taken."""
_MARGIN = 0.02  # [m] that random places keep from the workspace's rim


def to_action(action: np.ndarray) -> PickPlaceAction:
    """Return an environment's action (7,), whose lift the primitive's configuration decides."""
    pick_x, pick_y, pick_yaw, place_x, place_y, place_yaw = (float(v) for v in action[:6])
    return PickPlaceAction((pick_x, pick_y), pick_yaw, (place_x, place_y), place_yaw)


def tangent_at(mask: np.ndarray, view: TopDownView, xy: tuple[float, float]) -> float:
    """Return the cable's tangent [rad] in a mask near a point [m]; 0 where there is no cable."""
    row, column = np.rint(view.base_to_pixel(np.array(xy)))
    if not (0 <= row < mask.shape[0] and 0 <= column < mask.shape[1]):
        return 0.0
    grasp = find_strand_grasp(mask, (int(row), int(column)))
    return 0.0 if grasp is None else map_direction(grasp.tangent, np.eye(2))


class FailedPicks:
    """Where picking failed since something was last brought elsewhere."""

    def __init__(self) -> None:
        self._mask: np.ndarray | None = None
        self._picks: list[tuple[float, float]] = []

    def positions(self, seen: Observation) -> list[tuple[float, float]]:
        """Picks x, y [m] that failed since then, or were refused or skipped."""
        if _moved(seen, self._mask):
            self._picks = []
        self._mask = seen.mask
        return [*self._picks, *(action.pick_xy for action in seen.refused)]

    def chose(self, action: PickPlaceAction) -> None:
        """Remember an action; it counts as failed unless it brings the cable elsewhere."""
        self._picks.append(action.pick_xy)

    def includes(self, seen: Observation, action: PickPlaceAction) -> bool:
        """Whether the action's pick is near one of `positions`."""
        return any(math.dist(action.pick_xy, xy) < _NEAR for xy in self.positions(seen))


class RandomChooser:
    """Any point of the cable, to anywhere in the workspace; the baseline.

    Args:
        rng: draws
        view: the workspace
    """

    name = "random"

    def __init__(self, rng: np.random.Generator, *, view: TopDownView | None = None) -> None:
        self._rng = rng
        self._view = view or TopDownView()

    def reset(self) -> None:
        """Nothing is remembered."""

    def choose(self, seen: Observation) -> PickPlaceAction | None:
        """See `Chooser.choose`."""
        pixels = np.argwhere(seen.mask)
        if not len(pixels):
            return None
        x, y = self._view.pixel_to_base(pixels[self._rng.integers(len(pixels))])
        pick = float(x), float(y)
        ranges = (self._view.x, self._view.y)
        place = [float(self._rng.uniform(a + _MARGIN, b - _MARGIN)) for a, b in ranges]
        yaw = tangent_at(seen.mask, self._view, pick)
        return PickPlaceAction(pick, yaw, (place[0], place[1]), yaw)


class ScriptedChooser:
    """The scripted demonstrator of the simulated task on the twin's true state.

    Of a few beads it takes the farthest from its target, across the chain, and brings it there;
    others where those were missed.

    Args:
        look: tells the true state
        targets: where the beads are to lie, along the chain [m], (n, 2)
    """

    name = "scripted"

    def __init__(self, look: Callable[[], TwinLook], targets: np.ndarray) -> None:
        self._look, self._task = look, CableMaskGoal()
        self._failed_picks = FailedPicks()
        self._layout = Layout(np.zeros((0, 3)), np.zeros((0, 7)), targets)

    def reset(self) -> None:
        """Forget what was missed."""
        self._failed_picks = FailedPicks()

    def choose(self, seen: Observation) -> PickPlaceAction | None:
        """See `Chooser.choose`."""
        beads = self._look().beads
        snapshot = still_chain(beads - [0.0, 0.0, float(beads[:, 2].min())])
        rng = np.random.default_rng(0)  # asked for by the protocol; this demonstrator draws nothing
        moves = self._task.demonstrated_moves(self._layout, snapshot)
        others = self._task.candidates(self._layout, snapshot, rng, len(beads))
        for move in chain(moves, others):
            action = to_action(move)
            if not self._failed_picks.includes(seen, action):
                self._failed_picks.chose(action)
                return action
        return None


def still_chain(beads: np.ndarray) -> Snapshot:
    """Return beads (n, 3) [m] at rest as a task's snapshot, without pictures."""

    def render() -> None:
        raise InputError("a chain seen by a camera has no simulated picture")

    none = np.zeros((0, 7)), np.zeros((0, 6))
    return Snapshot(beads, np.zeros_like(beads), *none, (), render)  # type: ignore[arg-type]


class PolicyChooser:
    """A learned policy that `warp-deform train` made.

    It sees the mask as three channels of 0 or 255 and a height of zeros, as in `cable-mask-goal`,
    and has the memory of policies in simulation, `learning.policy.memory`. Where a finger would
    come down on the cable its next best pick is taken, unless its first eight are all like that;
    each that is passed over costs as much as choosing one.
    """

    def __init__(self, path: Path, *, view: TopDownView | None = None) -> None:
        from learning.policy.policy import ImagePolicy, load_policy

        self._view = view or TopDownView()
        policy = load_policy(path)
        task = policy.description.task
        if not isinstance(policy, ImagePolicy):
            raise InputError(f"{path} sees the simulator's state; give a policy that sees pictures")
        if task != CableMaskGoal.name or not fits_task(self._view):
            raise InputError(
                f"{path} was trained on {task}, and the workspace's pixels are "
                f"{1e3 * self._view.pixel_m:.3g} mm; give a policy of {CableMaskGoal.name} and a "
                f"workspace whose pixels are within {100 * PIXEL_RATIO:.0f} % of its "
                f"{1e3 * CableMaskGoal.grid.pixel_size:.3g} mm"
            )
        self._policy = policy
        self.reset()
        self.name = policy.description.agent

    def reset(self) -> None:
        """Forget what was missed and moved."""
        self._memory = self._policy.memory()
        self._seen: np.ndarray | None = None

    def choose(self, seen: Observation) -> PickPlaceAction | None:
        """See `Chooser.choose`.

        Raises:
            InputError: the policy needs a goal and there is none
        """
        if not seen.mask.any():
            return None
        if seen.goal is None and self._policy.agent.pictures == _TWO_PICTURES:
            raise InputError(f"{self.name} needs a goal; give --goal")
        avoid = self._memory.avoid(changed=_moved(seen, self._seen))
        self._seen = seen.mask
        goal = None if seen.goal is None else _picture(seen.goal)
        proposed = []
        for _ in range(_MOST_PROPOSALS):
            proposed.append(self._policy.act(_picture(seen.mask), goal, avoid=avoid))
            if has_finger_clearance(seen.mask, self._in_base(proposed[-1]), view=self._view):
                break
            avoid.append((proposed[-1][:2], _NEAR))
        else:
            proposed = proposed[:1]
        action = proposed[-1]
        self._memory.chose(action[:2], action[3:5])
        return self._in_base(action)

    def _in_base(self, action: np.ndarray) -> PickPlaceAction:
        """The policy's action (7,), which is on the task's table, on this one."""
        moved = np.array(action, dtype=float)
        moved[:2], moved[3:5] = (to_base(moved[i : i + 2], self._view) for i in (0, 3))
        return to_action(moved)


def _moved(seen: Observation, before: np.ndarray | None) -> bool:
    """Whether the last action brought the cable elsewhere than in the mask before.

    What was grasped in vain was not brought anywhere: fingers that met it may have pushed it, but
    meet it again where they are told to. Edges may differ by a pixel: that is noise.
    """
    if before is None:
        return True
    if seen.last in (PickPlaceOutcome.MISSED_GRASP, PickPlaceOutcome.OBSTRUCTED):
        return False
    near = np.ones((3, 3), np.uint8)
    return any(
        np.count_nonzero(a & (cv2.dilate(b.astype(np.uint8), near) == 0))
        > _SHIFTED * np.count_nonzero(a)
        for a, b in ((seen.mask, before), (before, seen.mask))
    )


def _picture(mask: np.ndarray) -> dict[str, np.ndarray]:
    levels = np.where(mask, 255, 0).astype(np.uint8)
    color = np.repeat(levels[..., None], 3, axis=2)
    return {"color": color, "height": np.zeros(mask.shape, np.float32)}
