"""Turns and shifts of the whole table, which multiply few demonstrations.

One transform moves the current picture, the goal's and both labelled pixels. For a picture it is
drawn again until both pixels stay in view. The relative yaw of pick and place does not change.

Source: Seita et al., ICRA 2021, appendix on training; Zeng et al., CoRL 2020, data augmentation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from warp_deform.errors import InputError
from warp_deform.rendering.pixels import SHAPE, TABLE_GRID, PixelGrid
from warp_deform.tasks.ground_truth import YAW_SCALE, Row, Rows, row_kinds, rows_of

__all__ = [
    "RigidTransform",
    "draw_transform",
    "draw_transforms",
    "move_actions",
    "move_picture",
    "move_points",
    "move_states",
]

_TURN = 2 * math.pi / 6
"""Standard deviation of the turn [rad]."""
_SHIFT = min(SHAPE) / 6
"""Standard deviation of the shift along either axis [pixels]."""
_PIVOT = np.array([SHAPE[1] / 2, SHAPE[0] / 2])
_MOST_DRAWS = 10_000


@dataclass(frozen=True)
class RigidTransform:
    """A mirror image or not, a turn about the middle of the picture, then a shift.

    Attributes:
        turn: [rad], from x to y, which is from columns to rows in a picture too
        shift: along x (columns) and y (rows) [pixels]
        grid: where on the table the pixels are
        mirror: swap left and right, which are rows, first
    """

    turn: float
    shift: tuple[float, float]
    grid: PixelGrid = TABLE_GRID
    mirror: bool = False

    @property
    def handed(self) -> float:
        """What angles are multiplied by: 1, or -1 in a mirror image."""
        return -1.0 if self.mirror else 1.0

    def matrix(self) -> np.ndarray:
        """(2, 3) float64, of column and row [pixels]."""
        return _matrices([self])[0]

    def of_pixels(self, pixels: np.ndarray) -> np.ndarray:
        """Where pixels (n, 2), row and column, go: float64 (n, 2)."""
        moved = self.matrix() @ np.column_stack([pixels[:, ::-1], np.ones(len(pixels))]).T
        return np.asarray(moved.T[:, ::-1])


def draw_transform(
    action: np.ndarray,
    *,
    rng: np.random.Generator,
    grid: PixelGrid = TABLE_GRID,
    copies: int | None = None,
    mirror: bool = False,
) -> RigidTransform:
    """A random transform that keeps pick and place of `action` (7,) within the picture.

    Args:
        copies: turn by one of so many even parts of a circle; None: by any angle, small ones more
            often
        mirror: every second one is a mirror image

    Raises:
        InputError: pick and place lie too far apart for one picture.
    """
    pixels = grid.to_pixel(np.stack([action[:2], action[3:5]]))
    mirrored = mirror and rng.random() < 0.5
    for _ in range(_MOST_DRAWS):
        if copies is None:
            turn = float(rng.normal(0.0, _TURN))
        else:
            turn = 2 * math.pi * int(rng.integers(copies)) / copies
        x, y = rng.normal(0.0, _SHIFT, size=2)
        drawn = RigidTransform(turn, (float(x), float(y)), grid, mirrored)
        if _in_view(drawn.of_pixels(pixels)):
            return drawn
    raise _too_far_apart(action)


def draw_transforms(
    actions: np.ndarray,
    *,
    rng: np.random.Generator,
    grid: PixelGrid = TABLE_GRID,
    copies: int | None = None,
    in_view: bool = True,
) -> list[RigidTransform]:
    """A random transform for each of many actions (B, 7), all at once; see `draw_transform`.

    Args:
        in_view: draw again what moves a pick or place out of the picture
    """
    actions = np.asarray(actions, dtype=float)
    pixels = grid.to_pixel(actions[:, [[0, 1], [3, 4]]])
    drawn: dict[int, RigidTransform] = {}
    left = np.arange(len(actions))
    for _ in range(_MOST_DRAWS):
        if len(left) == 0:
            return [drawn[i] for i in range(len(actions))]
        if copies is None:
            turns = rng.normal(0.0, _TURN, size=len(left))
        else:
            turns = 2 * math.pi * rng.integers(copies, size=len(left)) / copies
        shifts = rng.normal(0.0, _SHIFT, size=(len(left), 2))
        tried = [
            RigidTransform(turn, (x, y), grid)
            for turn, (x, y) in zip(turns.tolist(), shifts.tolist(), strict=True)
        ]
        matrix = _matrices(tried)
        columns = pixels[left][..., ::-1]
        moved = columns @ matrix[:, :, :2].transpose(0, 2, 1) + matrix[:, None, :, 2]
        seen = _in_view(moved[..., ::-1]) | (not in_view)
        drawn |= {int(left[k]): tried[k] for k in np.flatnonzero(seen)}
        left = left[~seen]
    raise _too_far_apart(actions[left[0]])


def _in_view(pixels: np.ndarray) -> np.ndarray:
    """Whether pixels (..., n, 2), row and column, all lie within the picture: (...)."""
    whole = np.round(pixels)
    return np.asarray(((whole >= 0) & (whole < SHAPE)).all(axis=(-2, -1)))


def _too_far_apart(action: np.ndarray) -> InputError:
    return InputError(
        f"pick {action[:2].tolist()} and place {action[3:5].tolist()} [m] of a demonstration do "
        "not fit into one picture"
    )


def _matrices(transforms: Sequence[RigidTransform]) -> np.ndarray:
    """(B, 2, 3) float64, of column and row [pixels].

    Cosines are Python's: numpy's depend on the processor in their last bit.
    """
    c = np.array([math.cos(each.turn) for each in transforms])
    s = np.array([math.sin(each.turn) for each in transforms])
    handed = np.array([each.handed for each in transforms])
    linear = np.stack([np.stack([c, -s * handed], 1), np.stack([s, c * handed], 1)], 1)
    shift = _PIVOT + np.array([each.shift for each in transforms]) - linear @ _PIVOT
    return np.concatenate([linear, shift[:, :, None]], 2)


def move_picture(
    color: np.ndarray, height: np.ndarray, transform: RigidTransform
) -> tuple[np.ndarray, np.ndarray]:
    """A picture, colour (H, W, 3) uint8 and height (H, W) [m], moved; what comes into view is 0."""
    matrix = transform.matrix()
    size = SHAPE[1], SHAPE[0]
    moved_color, moved_height = (
        np.asarray(cv2.warpAffine(image, matrix, size, flags=cv2.INTER_NEAREST))
        for image in (color, height)
    )
    return moved_color, moved_height


def move_actions(actions: np.ndarray, transforms: Sequence[RigidTransform]) -> np.ndarray:
    """Actions (B, 7), with pick and place moved; yaws stay, as in the original, or are mirrored."""
    moved = np.array(actions, dtype=float)
    moved[:, [2, 5]] *= np.array([each.handed for each in transforms])[:, None]
    for x, y in ((0, 1), (3, 4)):
        moved[:, [x, y]] = move_points(moved[:, None, [x, y]], transforms)[:, 0]
    return moved


def move_states(
    layout: Rows, states: np.ndarray, transforms: Sequence[RigidTransform]
) -> np.ndarray:
    """Ground-truth states (B, D) float32 of a task, each moved.

    Args:
        layout: what their numbers are, `Task.ground_truth_rows`

    Raises:
        InputError: the ground truth has another size, or the task does not say what it is.
    """
    kind, (count, size) = row_kinds(layout), states.shape
    if size != 3 * len(kind):
        raise InputError(
            f"a ground truth of {size} numbers, {3 * len(kind)} of them in ground_truth_rows of "
            "its task, cannot be moved; train with --no-augment"
        )
    rows = states.reshape(count, -1, 3).astype(float)
    turned, shown = rows_of(kind, [Row.POSE, Row.BEAD]), rows_of(kind, [Row.DISPLACEMENT])
    placed = turned | rows_of(kind, [Row.POINT])
    linear = _matrices(transforms)[:, :, :2]
    rows[:, placed, :2] = move_points(rows[:, placed, :2], transforms)
    rows[:, shown, :2] = rows[:, shown, :2] @ linear.transpose(0, 2, 1)
    handed, turn = np.array([(each.handed, each.turn) for each in transforms]).T[..., None]
    yaw = -YAW_SCALE * rows[:, turned, 2] * handed + turn
    rows[:, turned, 2] = -np.arctan2(np.sin(yaw), np.cos(yaw)) / YAW_SCALE
    return rows.reshape(count, size).astype(np.float32)


def move_points(xy: np.ndarray, transforms: Sequence[RigidTransform]) -> np.ndarray:
    """World points (B, n, 2) [m], those of every entry moved by its transform."""
    matrix = _matrices(transforms)
    grids = {each.grid for each in transforms}
    origins = {grid: grid.to_world(np.zeros(2)) for grid in grids}
    origin = np.array([origins[each.grid] for each in transforms])[:, None]
    pixel = np.array([each.grid.pixel_size for each in transforms])[:, None]
    shift = (matrix[:, :, 2] * pixel)[:, None]
    return np.asarray((xy - origin) @ matrix[:, :, :2].transpose(0, 2, 1) + shift + origin)
