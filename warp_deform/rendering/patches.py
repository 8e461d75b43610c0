"""Which patches of a picture have to be shaded again.

A patch is a square of pixels. What it shows depends on what its samples see, and on the tiles of
the lamp's buffer and of the view from above where its points looked for shadows. Shading notes the
rows and columns there, and what the points compared with what is there: a patch is stale when
something it sees changed, or when one of these comparisons may come out differently.
"""

from __future__ import annotations

import warp as wp

from .occlusion import CELL, MOST, SOFT, TILE, Occluders, shadow_limit

__all__ = ["LOOKS", "PATCH", "find_stale", "note_above", "note_lamp"]

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

PATCH = 8
"""Pixels along a patch's side."""
LOOKS = 16
"""Numbers noted for each patch, of the lamp's buffer and then of the view from above.

First and last row, first and last column of cells; least and greatest inverse depth that was asked
for (its bits), least and greatest height that was compared with the tops [0.01 mm].
"""

HEIGHTS = wp.constant(1.0e5)  # to a metre


@wp.func
def note_look(
    at: wp.vec3,
    reach: float,
    least: int,
    greatest: int,
    height: float,
    patch: int,
    slot: int,
    looks: wp.array2d(dtype=int),
):
    """Note a look at column and row `at`, `reach` samples to all sides; none where negative."""
    if at[0] >= 0.0:
        level = int(wp.floor(height * HEIGHTS))
        wp.atomic_min(looks, patch, slot, int(at[1] - reach) / CELL)
        wp.atomic_max(looks, patch, slot + 1, int(at[1] + reach) / CELL)
        wp.atomic_min(looks, patch, slot + 2, int(at[0] - reach) / CELL)
        wp.atomic_max(looks, patch, slot + 3, int(at[0] + reach) / CELL)
        wp.atomic_min(looks, patch, slot + 4, least)
        wp.atomic_max(looks, patch, slot + 5, greatest)
        wp.atomic_min(looks, patch, slot + 6, level)
        wp.atomic_max(looks, patch, slot + 7, level)


@wp.func
def note_lamp(at: wp.vec3, height: float, patch: int, looks: wp.array2d(dtype=int)):
    """Note what `lit_share` asks: whether samples are nearer to the lamp than a limit."""
    limit = shadow_limit(at)
    note_look(at, float(SOFT) + 1.0, limit, limit, height, patch, 0, looks)


@wp.func
def note_above(at: wp.vec3, reach: float, height: float, patch: int, looks: wp.array2d(dtype=int)):
    """Note what `open_share` asks: how far samples are above the point, if they are."""
    note_look(at, reach, wp.cast(1.0 / at[2], wp.int32), MOST, height, patch, 8, looks)


@wp.func
def looks_changed(seen: Occluders, patch: int, slot: int, looks: wp.array2d(dtype=int)):
    """Whether a comparison that a patch noted may come out differently now."""
    row = looks[patch, slot]
    last_row = looks[patch, slot + 1]
    column = looks[patch, slot + 2]
    last_column = looks[patch, slot + 3]
    if last_row < row:
        return False
    limit = looks[patch, slot + 4]
    last_limit = looks[patch, slot + 5]
    for i in range(row, last_row + 1):
        for j in range(column, last_column + 1):
            if seen.greatest[i, j] >= limit and seen.least[i, j] < last_limit:
                return True
    height = float(looks[patch, slot + 6])
    last_height = float(looks[patch, slot + 7]) + 1.0
    for i in range(row * CELL / TILE, last_row * CELL / TILE + 1):
        for j in range(column * CELL / TILE, last_column * CELL / TILE + 1):
            low = seen.lowest_top[i, j]
            high = seen.highest_top[i, j]
            if low < high and low * HEIGHTS < last_height and high * HEIGHTS >= height:
                return True
    return False


@wp.kernel
def find_stale(
    tiles: wp.array2d(dtype=int),
    lamp: Occluders,
    above: Occluders,
    looks: wp.array2d(dtype=int),
    stale: wp.array2d(dtype=wp.uint8),
):
    """One thread a patch: whether it is to be shaded again; if so, its looks are forgotten.

    tiles: where the picture's own z-buffer changed, one a patch
    """
    i, j = wp.tid()
    patch = i * tiles.shape[1] + j
    if (
        tiles[i, j] != 0
        or looks_changed(lamp, patch, 0, looks)
        or looks_changed(above, patch, 8, looks)
    ):
        stale[i, j] = wp.uint8(1)
        for slot in range(0, LOOKS, 2):
            looks[patch, slot] = MOST
            looks[patch, slot + 1] = -MOST
    else:
        stale[i, j] = wp.uint8(0)
