"""Turns and shifts of the whole table, which multiply few demonstrations.

One transform moves the current picture, the goal's and both labelled pixels. It is drawn again
until both pixels stay in view. The relative yaw of pick and place does not change.

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
        c, s = math.cos(self.turn), math.sin(self.turn)
        linear = np.array([[c, -s * self.handed], [s, c * self.handed]])
        matrix = np.empty((2, 3))
        matrix[:, :2], matrix[:, 2] = linear, _PIVOT + self.shift - linear @ _PIVOT
        return matrix

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
        moved = np.round(drawn.of_pixels(pixels))
        if ((moved >= 0) & (moved < SHAPE)).all():
            return drawn
    raise InputError(
        f"pick {action[:2].tolist()} and place {action[3:5].tolist()} [m] of a demonstration do "
        "not fit into one picture"
    )


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
    linear = np.array([each.matrix()[:, :2] for each in transforms])
    rows[:, placed, :2] = move_points(rows[:, placed, :2], transforms)
    rows[:, shown, :2] = rows[:, shown, :2] @ linear.transpose(0, 2, 1)
    handed, turn = np.array([(each.handed, each.turn) for each in transforms]).T[..., None]
    yaw = -YAW_SCALE * rows[:, turned, 2] * handed + turn
    rows[:, turned, 2] = -np.arctan2(np.sin(yaw), np.cos(yaw)) / YAW_SCALE
    return rows.reshape(count, size).astype(np.float32)


def move_points(xy: np.ndarray, transforms: Sequence[RigidTransform]) -> np.ndarray:
    """World points (B, n, 2) [m], those of every entry moved by its transform."""
    matrix = np.array([each.matrix() for each in transforms])
    origin = np.array([each.grid.to_world(np.zeros(2)) for each in transforms])[:, None]
    pixel = np.array([each.grid.pixel_size for each in transforms])[:, None]
    shift = (matrix[:, :, 2] * pixel)[:, None]
    return np.asarray((xy - origin) @ matrix[:, :, :2].transpose(0, 2, 1) + shift + origin)
