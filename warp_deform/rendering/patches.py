"""Which patches of a picture have to be shaded again.

A patch is a square of pixels. What it shows depends on what its samples see, and on the tiles of
the lamp's buffer and of the view from above where its points looked for shadows. Shading notes the
rows and columns of these tiles; a patch is stale when something it sees changed, or one of them.
"""

from __future__ import annotations

import warp as wp

from .occlusion import TILE, Occluders

__all__ = ["LOOKS", "PATCH", "find_stale", "note_look"]

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

PATCH = 8
"""Pixels along a patch's side."""
LOOKS = 8
"""Numbers noted for each patch: first and last row, first and last column, of lamp and above."""

NOWHERE = wp.constant(1 << 20)


@wp.func
def note_look(at: wp.vec3, reach: float, patch: int, slot: int, looks: wp.array2d(dtype=int)):
    """Note a look at column and row `at`, `reach` samples to all sides; none where negative."""
    if at[0] >= 0.0:
        wp.atomic_min(looks, patch, slot, int(at[1] - reach) / TILE)
        wp.atomic_max(looks, patch, slot + 1, int(at[1] + reach) / TILE)
        wp.atomic_min(looks, patch, slot + 2, int(at[0] - reach) / TILE)
        wp.atomic_max(looks, patch, slot + 3, int(at[0] + reach) / TILE)


@wp.func
def looks_changed(
    changed_near: wp.array2d(dtype=int), patch: int, slot: int, looks: wp.array2d(dtype=int)
):
    """Whether something changed in or beside the tiles that a patch looked at."""
    for i in range(looks[patch, slot], looks[patch, slot + 1] + 1):
        for j in range(looks[patch, slot + 2], looks[patch, slot + 3] + 1):
            if changed_near[i, j] != 0:
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
        or looks_changed(lamp.changed_near, patch, 0, looks)
        or looks_changed(above.changed_near, patch, 4, looks)
    ):
        stale[i, j] = wp.uint8(1)
        for slot in range(0, LOOKS, 2):
            looks[patch, slot] = NOWHERE
            looks[patch, slot + 1] = -1
    else:
        stale[i, j] = wp.uint8(0)
