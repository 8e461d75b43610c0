"""Which patches of a picture have to be shaded again.

A patch is a square of pixels. What it shows depends on what its samples see, and on the cells of
the lamp's buffer and of the view from above where its points looked for shadows. Shading notes the
rows and columns there, and what the points compared with what is there: a patch is stale when
something it sees changed, or when one of these comparisons may come out differently.
"""

from __future__ import annotations

import warp as wp

from .occlusion import CELL, TILE, Occluders

__all__ = ["LOOKS", "PATCH", "find_stale", "keep_looks", "look", "no_look"]

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

PATCH = 8
"""Pixels along a patch's side."""
LOOKS = 12
"""Numbers noted for each patch, of the lamp's buffer and then of the view from above.

First and last row, first and last column of cells; the least and the greatest depth that samples
there were compared with, as bits, which sort alike.
"""
SIDE = wp.constant(LOOKS // 2)
MOST = wp.constant(0x7FFFFFFF)
FAR_OFF = wp.constant(1.0e9)


@wp.func
def no_look():
    """The bounds of no look: least row, column and depth, and the greatest ones negated."""
    return wp.spatial_vector(FAR_OFF, FAR_OFF, FAR_OFF, FAR_OFF, FAR_OFF, FAR_OFF)


@wp.func
def look(at: wp.vec3, reach: float, least: float, greatest: float):
    """The bounds of a look at column and row `at`, `reach` samples to all sides."""
    if at[0] < 0.0:
        return no_look()
    return wp.spatial_vector(
        at[1] - reach, at[0] - reach, least, -(at[1] + reach), -(at[0] + reach), -greatest
    )


@wp.func
def keep_looks(bounds: wp.spatial_vector, patch: int, slot: int, looks: wp.array2d(dtype=int)):
    """Add the bounds of some looks to what a patch noted."""
    if bounds[0] < FAR_OFF:
        wp.atomic_min(looks, patch, slot, int(bounds[0]) / CELL)
        wp.atomic_max(looks, patch, slot + 1, int(-bounds[3]) / CELL)
        wp.atomic_min(looks, patch, slot + 2, int(bounds[1]) / CELL)
        wp.atomic_max(looks, patch, slot + 3, int(-bounds[4]) / CELL)
        wp.atomic_min(looks, patch, slot + 4, wp.cast(bounds[2], wp.int32))
        wp.atomic_max(looks, patch, slot + 5, wp.cast(-bounds[5], wp.int32))


@wp.func
def looks_changed(
    changed: wp.array2d(dtype=int),
    least: wp.array2d(dtype=float),
    greatest: wp.array2d(dtype=float),
    patch: int,
    slot: int,
    looks: wp.array2d(dtype=int),
):
    """Whether a comparison that a patch noted may come out differently now."""
    row = looks[patch, slot]
    last_row = looks[patch, slot + 1]
    column = looks[patch, slot + 2]
    last_column = looks[patch, slot + 3]
    if last_row < row:
        return False
    may_differ = bool(False)
    for i in range(row * CELL / TILE, last_row * CELL / TILE + 1):
        for j in range(column * CELL / TILE, last_column * CELL / TILE + 1):
            if changed[i, j] != 0:
                may_differ = True
    if not may_differ:
        return False
    limit = wp.cast(looks[patch, slot + 4], float)
    last_limit = wp.cast(looks[patch, slot + 5], float)
    for i in range(row, last_row + 1):
        for j in range(column, last_column + 1):
            if changed[i * CELL / TILE, j * CELL / TILE] != 0:
                if least[i, j] < last_limit and greatest[i, j] >= limit:
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

    Args:
        tiles: where the picture's own z-buffer changed, one a patch
    """
    i, j = wp.tid()
    patch = i * tiles.shape[1] + j
    if (
        tiles[i, j] != 0
        or looks_changed(lamp.changed, lamp.least, lamp.greatest, patch, 0, looks)
        or looks_changed(above.changed, above.least, above.greatest, patch, SIDE, looks)
    ):
        stale[i, j] = wp.uint8(1)
        for slot in range(0, LOOKS, 2):
            looks[patch, slot] = MOST
            looks[patch, slot + 1] = -MOST
    else:
        stale[i, j] = wp.uint8(0)
