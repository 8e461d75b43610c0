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
from .pinhole import View, draw, inverse_depth, ray, to_camera, view_of

__all__ = ["Occluders", "draw_occluders", "lit_share", "occluders", "open_share"]

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

TILE = wp.constant(16)  # samples along a side
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


def occluders(camera: Camera, device: wp.Device) -> Occluders:
    """Empty buffers for what `camera` sees; its size is a multiple of the tile's."""
    result = Occluders()
    result.view = view_of(camera)
    result.keys = wp.zeros(camera.size, dtype=wp.int64, device=device)
    tiles = (camera.size[0] // TILE, camera.size[1] // TILE)
    result.tops = wp.full(tiles, NOWHERE, dtype=float, device=device)
    result.tops_near = wp.full(tiles, NOWHERE, dtype=float, device=device)
    return result


@wp.kernel
def find_tops(view: View, keys: wp.array2d(dtype=wp.int64), tops: wp.array2d(dtype=float)):
    """One thread a tile: its highest point."""
    i, j = wp.tid()
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
def spread_tops(tops: wp.array2d(dtype=float), tops_near: wp.array2d(dtype=float)):
    """One thread a tile: the highest point of it and its neighbours."""
    i, j = wp.tid()
    top = float(NOWHERE)
    for r in range(wp.max(i - 1, 0), wp.min(i + 2, tops.shape[0])):
        for c in range(wp.max(j - 1, 0), wp.min(j + 2, tops.shape[1])):
            top = wp.max(top, tops[r, c])
    tops_near[i, j] = top


def draw_occluders(target: Occluders, geometry: Geometry, *, links: bool) -> None:
    """Fill `target` with what its view sees of `geometry`."""
    draw(geometry, target.view, target.keys, links=links)
    tiles, device = target.tops.shape, geometry.device
    wp.launch(find_tops, tiles, inputs=[target.view, target.keys, target.tops], device=device)
    wp.launch(spread_tops, tiles, inputs=[target.tops, target.tops_near], device=device)


@wp.func
def lit_share(lamp: Occluders, p: wp.vec3, n: wp.vec3):
    """Share of the lamp's light that reaches `p`: a soft-edged box filter over its z-buffer."""
    q = to_camera(lamp.view, p + n * OFFSET)
    if q[2] < 0.1:
        return 1.0
    x = q[0] / q[2] * lamp.view.fx + lamp.view.cx
    y = q[1] / q[2] * lamp.view.fy + lamp.view.cy
    edge = float(SOFT) + 1.0
    if (
        x < edge
        or y < edge
        or x > float(lamp.view.columns) - edge - 2.0
        or y > float(lamp.view.rows) - edge - 2.0
    ):
        return 1.0
    c = int(x)
    r = int(y)
    if lamp.tops_near[r / TILE, c / TILE] < p[2] + n[2] * OFFSET:
        return 1.0
    limit = wp.int64(wp.cast(1.0 / (q[2] - SLACK), wp.int32)) << wp.int64(32)
    # most points are wholly lit or wholly dark: ask the filter's corners and centre first
    hidden = int(0)
    for i in range(-1, 2):
        for j in range(-1, 2):
            if i * i == j * j and lamp.keys[r + i * SOFT, c + j * SOFT] > limit:
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
            if lamp.keys[r + i, c + j] > limit:
                total += wx * wy
    width = float(2 * SOFT + 1)
    return 1.0 - total / (width * width)


@wp.func
def open_share(above: Occluders, p: wp.vec3, n: wp.vec3):
    """Share of the ambient light that nearby things leave to `p`, from the heights around it."""
    q = to_camera(above.view, p + n * (OFFSET + 0.001))
    x = q[0] / q[2] * above.view.fx + above.view.cx + 0.5
    y = q[1] / q[2] * above.view.fy + above.view.cy + 0.5
    # samples between two taps; five taps reach 18 mm to either side, less than a tile
    reach = above.view.fx / q[2] * 0.009
    margin = 2.0 * reach + 1.0
    if (
        x < margin
        or y < margin
        or x > float(above.view.columns) - margin
        or y > float(above.view.rows) - margin
        or above.tops_near[int(y) / TILE, int(x) / TILE] < p[2] + SLACK
    ):
        return 1.0
    total = float(0.0)
    for i in range(-2, 3):
        for j in range(-2, 3):
            key = above.keys[int(y + float(i) * reach), int(x + float(j) * reach)]
            if key > wp.int64(0):
                rise = q[2] - 1.0 / inverse_depth(key)
                if rise > SLACK:
                    total += rise / (rise + 0.006) / (1.0 + rise * rise * 150.0)
    return 1.0 - total / 25.0
