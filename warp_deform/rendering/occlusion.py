"""Soft shadows and ambient occlusion, looked up in z-buffers of the lamp and of a view from above.

Both views are from high up, so what hides a point from them is higher than the point. The highest
thing near every tile of a buffer is kept as well, and most points are settled by one look at it.

Source: Williams, "Casting curved shadows on curved surfaces", SIGGRAPH 1978; Reeves et al.,
"Rendering antialiased shadows with depth maps", SIGGRAPH 1987.
"""

from __future__ import annotations

import warp as wp

from .camera import Camera
from .geometry import Geometry
from .pinhole import View, inverse_depth, ray, to_camera, view_of
from .zbuffer import ZBuffer

__all__ = ["OccluderBuffer", "Occluders", "above_sample", "lamp_sample", "lit_share", "open_share",
           "shadow_limit", "tap_reach"]  # fmt: skip

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

TILE = wp.constant(16)  # samples along a side
CELL = wp.constant(4)  # the same of the squares in which changes are told apart
MOST = wp.constant(0x7FFFFFFF)
SOFT = wp.constant(3)  # half width of the shadow's filter in samples
NOWHERE = wp.constant(-1.0e6)  # height of the highest thing where there is nothing [m]
# A point starts this far off its surface [m], so that no surface hides itself.
OFFSET = wp.constant(0.003)
SLACK = wp.constant(0.002)


@wp.struct
class Occluders:
    """What a view from high up sees first."""

    view: View
    keys: wp.array2d(dtype=wp.int64)
    tops: wp.array2d(dtype=float)  # highest world z in each tile [m]
    tops_near: wp.array2d(dtype=float)  # the same over a tile and its eight neighbours
    lowest_top: wp.array2d(dtype=float)  # the lower of that and of what it was before
    highest_top: wp.array2d(dtype=float)  # the higher
    # bits of the least and the greatest inverse depth that a sample of each cell changed from or
    # to; the greatest is -1 where none changed
    least: wp.array2d(dtype=int)
    greatest: wp.array2d(dtype=int)


@wp.kernel
def find_tops(
    view: View,
    tiles: wp.array2d(dtype=int),
    keys: wp.array2d(dtype=wp.int64),
    tops: wp.array2d(dtype=float),
):
    """One thread a tile: its highest point, where it changed."""
    i, j = wp.tid()
    if tiles[i, j] == 0:
        return
    top = float(NOWHERE)
    for r in range(i * TILE, (i + 1) * TILE):
        for c in range(j * TILE, (j + 1) * TILE):
            key = keys[r, c]
            if key > wp.int64(0):
                d = ray(view, float(r), float(c))
                rise = view.right[2] * d[0] + view.down[2] * d[1] + view.forward[2]
                top = wp.max(top, view.origin[2] + rise / inverse_depth(key))
    tops[i, j] = top


@wp.kernel
def find_changes(
    everything: int,
    tiles: wp.array2d(dtype=int),
    before: wp.array2d(dtype=wp.int64),
    keys: wp.array2d(dtype=wp.int64),
    least: wp.array2d(dtype=int),
    greatest: wp.array2d(dtype=int),
):
    """One thread a cell: between which inverse depths its samples changed."""
    i, j = wp.tid()
    low = int(MOST)
    high = int(-1)
    if everything == 1:
        low = 0
        high = MOST
    elif tiles[i * CELL / TILE, j * CELL / TILE] != 0:
        for r in range(i * CELL, (i + 1) * CELL):
            for c in range(j * CELL, (j + 1) * CELL):
                old = int(before[r, c] >> wp.int64(32))
                new = int(keys[r, c] >> wp.int64(32))
                if old != new:
                    low = wp.min(low, wp.min(old, new))
                    high = wp.max(high, wp.max(old, new))
    least[i, j] = low
    greatest[i, j] = high


@wp.kernel
def spread_tops(
    tops: wp.array2d(dtype=float),
    tops_near: wp.array2d(dtype=float),
    lowest_top: wp.array2d(dtype=float),
    highest_top: wp.array2d(dtype=float),
):
    """One thread a tile: the highest point of it and its neighbours, now and as it was."""
    i, j = wp.tid()
    top = float(NOWHERE)
    for r in range(wp.max(i - 1, 0), wp.min(i + 2, tops.shape[0])):
        for c in range(wp.max(j - 1, 0), wp.min(j + 2, tops.shape[1])):
            top = wp.max(top, tops[r, c])
    lowest_top[i, j] = wp.min(top, tops_near[i, j])
    highest_top[i, j] = wp.max(top, tops_near[i, j])
    tops_near[i, j] = top


class OccluderBuffer:
    """A view from high up, whose size is a multiple of the tile's, and what it sees.

    seen: what a shader reads
    """

    def __init__(self, camera: Camera, *, links: bool, device: wp.Device) -> None:
        self._device = device
        self._buffer = ZBuffer(
            view_of(camera), side=TILE, links=links, remember=True, device=device
        )
        tiles = self._buffer.shape
        self.seen = Occluders()
        self.seen.view, self.seen.keys = self._buffer.view, self._buffer.keys
        self.seen.tops = wp.full(tiles, NOWHERE, dtype=float, device=device)
        self.seen.tops_near = wp.full(tiles, NOWHERE, dtype=float, device=device)
        self.seen.lowest_top = wp.full(tiles, NOWHERE, dtype=float, device=device)
        self.seen.highest_top = wp.full(tiles, NOWHERE, dtype=float, device=device)
        cells = tuple(TILE // CELL * count for count in tiles)
        self.seen.least = wp.zeros(cells, dtype=int, device=device)
        self.seen.greatest = wp.zeros(cells, dtype=int, device=device)

    def draw(self, geometry: Geometry) -> None:
        """Bring it up to date."""
        self._buffer.draw(geometry)
        seen, tiles = self.seen, self._buffer.tiles
        changes = [int(self._buffer.everything), tiles, self._buffer.before, seen.keys]
        tops = [seen.tops, seen.tops_near, seen.lowest_top, seen.highest_top]
        for kernel, shape, inputs in (
            (find_changes, seen.least.shape, [*changes, seen.least, seen.greatest]),
            (find_tops, tiles.shape, [seen.view, tiles, seen.keys, seen.tops]),
            (spread_tops, tiles.shape, tops),
        ):
            wp.launch(kernel, shape, inputs=inputs, device=self._device)


@wp.func
def lamp_sample(view: View, p: wp.vec3, n: wp.vec3):
    """Column, row and depth [m] at which `lit_share` looks; a negative column for nowhere."""
    q = to_camera(view, p + n * OFFSET)
    if q[2] < 0.1:
        return wp.vec3(-1.0, -1.0, 1.0)
    x = q[0] / q[2] * view.fx + view.cx
    y = q[1] / q[2] * view.fy + view.cy
    edge = float(SOFT) + 1.0
    if (
        x < edge
        or y < edge
        or x > float(view.columns) - edge - 2.0
        or y > float(view.rows) - edge - 2.0
    ):
        return wp.vec3(-1.0, -1.0, 1.0)
    return wp.vec3(x, y, q[2])


@wp.func
def shadow_limit(at: wp.vec3):
    """Bits of the inverse depth from which on a sample hides the point of a `lamp_sample`."""
    return wp.cast(1.0 / (at[2] - SLACK), wp.int32)


@wp.func
def lit_share(
    keys: wp.array2d(dtype=wp.int64),
    tops_near: wp.array2d(dtype=float),
    at: wp.vec3,
    p: wp.vec3,
    n: wp.vec3,
):
    """Share of the lamp's light that reaches `p`: a soft-edged box filter over its z-buffer.

    at: `lamp_sample` of the point; tiles beyond the neighbours of its own are not read
    """
    if at[0] < 0.0:
        return 1.0
    x = at[0]
    y = at[1]
    c = int(x)
    r = int(y)
    if tops_near[r / TILE, c / TILE] < p[2] + n[2] * OFFSET:
        return 1.0
    limit = wp.int64(shadow_limit(at)) << wp.int64(32)
    # most points are wholly lit or wholly dark: ask the filter's corners and centre first
    hidden = int(0)
    for i in range(-1, 2):
        for j in range(-1, 2):
            if i * i == j * j and keys[r + i * SOFT, c + j * SOFT] > limit:
                hidden += 1
    if hidden == 0:
        return 1.0
    if hidden == 5:
        return 0.0
    fx = x - float(c)
    fy = y - float(r)
    total = float(0.0)
    for i in range(-SOFT, SOFT + 2):
        wy = float(1.0)
        if i == -SOFT:
            wy = 1.0 - fy
        if i == SOFT + 1:
            wy = fy
        for j in range(-SOFT, SOFT + 2):
            wx = float(1.0)
            if j == -SOFT:
                wx = 1.0 - fx
            if j == SOFT + 1:
                wx = fx
            if keys[r + i, c + j] > limit:
                total += wx * wy
    width = float(2 * SOFT + 1)
    return 1.0 - total / (width * width)


@wp.func
def tap_reach(view: View, depth: float):
    """Samples between two of the taps of `open_share`."""
    # five taps reach 18 mm to either side, less than a tile
    return view.fx / depth * 0.009


@wp.func
def above_sample(view: View, p: wp.vec3, n: wp.vec3):
    """Column, row and depth [m] around which `open_share` looks; a negative column for nowhere."""
    q = to_camera(view, p + n * (OFFSET + 0.001))
    if q[2] < 0.1:
        return wp.vec3(-1.0, -1.0, 1.0)
    x = q[0] / q[2] * view.fx + view.cx + 0.5
    y = q[1] / q[2] * view.fy + view.cy + 0.5
    margin = 2.0 * tap_reach(view, q[2]) + 1.0
    if (
        x < margin
        or y < margin
        or x > float(view.columns) - margin
        or y > float(view.rows) - margin
    ):
        return wp.vec3(-1.0, -1.0, 1.0)
    return wp.vec3(x, y, q[2])


@wp.func
def open_share(
    view: View,
    keys: wp.array2d(dtype=wp.int64),
    tops_near: wp.array2d(dtype=float),
    at: wp.vec3,
    p: wp.vec3,
):
    """Share of the ambient light that nearby things leave to `p`, from the heights around it.

    at: `above_sample` of the point
    """
    if at[0] < 0.0 or tops_near[int(at[1]) / TILE, int(at[0]) / TILE] < p[2] + SLACK:
        return 1.0
    x = at[0]
    y = at[1]
    reach = tap_reach(view, at[2])
    total = float(0.0)
    for i in range(-2, 3):
        for j in range(-2, 3):
            key = keys[int(y + float(i) * reach), int(x + float(j) * reach)]
            if key > wp.int64(0):
                rise = at[2] - 1.0 / inverse_depth(key)
                if rise > SLACK:
                    total += rise / (rise + 0.006) / (1.0 + rise * rise * 150.0)
    return 1.0 - total / 25.0
