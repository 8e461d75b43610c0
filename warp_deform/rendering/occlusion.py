"""Soft shadows and ambient occlusion, looked up in z-buffers of the lamp and of a view from above.

The buffers are cut into cells, and every cell knows the nearest thing around it: most points are
settled by one look at that.

Source: Williams, "Casting curved shadows on curved surfaces", SIGGRAPH 1978; Reeves et al.,
"Rendering antialiased shadows with depth maps", SIGGRAPH 1987; Greene, Kass and Miller,
"Hierarchical Z-buffer visibility", SIGGRAPH 1993.
"""

from __future__ import annotations

import warp as wp

from .camera import Camera
from .geometry import Geometry
from .pinhole import View, inverse_depth, to_camera, view_of
from .zbuffer import ZBuffer

__all__ = [
    "NOWHERE",
    "OccluderBuffer",
    "Occluders",
    "above_limit",
    "above_sample",
    "lamp_limit",
    "lamp_sample",
    "lit_share",
    "open_share",
    "tap_reach",
]

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

TILE = wp.constant(16)  # samples along a side
CELL = wp.constant(4)  # the same of the squares in which changes are told apart
NOWHERE = wp.constant(1.0e9)  # depth where there is nothing [m]
SOFT = wp.constant(3)  # half width of the shadow's filter in samples
TAPS = wp.constant(2)  # looks to either side for ambient light
# cells around its own that a look can reach
LAMP_SPREAD = 1
ABOVE_SPREAD = wp.constant(3)
# A point starts this far off its surface [m], so that no surface hides itself.
OFFSET = wp.constant(0.003)
SLACK = wp.constant(0.002)


@wp.struct
class Occluders:
    """What a view from high up sees first, as depths [m]; `NOWHERE` where there is nothing."""

    view: View
    depths: wp.array2d(dtype=float)
    peaks: wp.array2d(dtype=float)  # least depth in each cell
    nearest: wp.array2d(dtype=float)  # the same over a cell and those around it
    changed: wp.array2d(dtype=int)  # 1 for tiles that the last drawing changed
    # the least and the greatest depth that a sample of each cell of these tiles changed from or
    # to; the least is beyond the greatest where none changed
    least: wp.array2d(dtype=float)
    greatest: wp.array2d(dtype=float)


@wp.kernel
def find_changes(
    everything: int,
    keys: wp.array2d(dtype=wp.int64),
    tiles: wp.array2d(dtype=int),
    depths: wp.array2d(dtype=float),
    peaks: wp.array2d(dtype=float),
    least: wp.array2d(dtype=float),
    greatest: wp.array2d(dtype=float),
):
    """One thread a tile, where it was drawn again: its depths, and how those of cells changed.

    Loops are `while` where they are short, as a `for` of unknown bounds is slow.
    """
    i, j = wp.tid()
    if tiles[i, j] == 0:
        return
    for m in range(i * TILE / CELL, (i + 1) * TILE / CELL):
        for n in range(j * TILE / CELL, (j + 1) * TILE / CELL):
            low = float(NOWHERE)
            high = float(0.0)
            peak = float(NOWHERE)
            r = m * CELL
            while r < (m + 1) * CELL:
                c = n * CELL
                while c < (n + 1) * CELL:
                    old = depths[r, c]
                    new = wp.min(1.0 / inverse_depth(keys[r, c]), NOWHERE)
                    peak = wp.min(peak, new)
                    if old != new:
                        low = wp.min(low, wp.min(old, new))
                        high = wp.max(high, wp.max(old, new))
                        depths[r, c] = new
                    c += 1
                r += 1
            if everything == 1:
                low = 0.0
                high = NOWHERE
            peaks[m, n] = peak
            least[m, n] = low
            greatest[m, n] = high


@wp.kernel
def spread_peaks(
    spread: int,
    tiles: wp.array2d(dtype=int),
    peaks: wp.array2d(dtype=float),
    nearest: wp.array2d(dtype=float),
):
    """One thread a tile: the nearest thing around each of its cells, where it may have changed."""
    i, j = wp.tid()
    may_differ = bool(False)
    for m in range(wp.max(i - 1, 0), wp.min(i + 2, tiles.shape[0])):
        for n in range(wp.max(j - 1, 0), wp.min(j + 2, tiles.shape[1])):
            if tiles[m, n] != 0:
                may_differ = True
    if not may_differ:
        return
    for m in range(i * TILE / CELL, (i + 1) * TILE / CELL):
        for n in range(j * TILE / CELL, (j + 1) * TILE / CELL):
            peak = float(NOWHERE)
            r = wp.max(m - spread, 0)
            while r < wp.min(m + spread + 1, peaks.shape[0]):
                c = wp.max(n - spread, 0)
                while c < wp.min(n + spread + 1, peaks.shape[1]):
                    peak = wp.min(peak, peaks[r, c])
                    c += 1
                r += 1
            nearest[m, n] = peak


class OccluderBuffer:
    """A view from high up, whose size is a multiple of the tile's, and what it sees.

    `seen` is what a shader reads.

    Args:
        spread: cells around its own, at most a tile of them, that a look can reach
    """

    def __init__(self, camera: Camera, *, spread: int, links: bool, device: wp.Device) -> None:
        self._device, self._spread = device, spread
        self._buffer = ZBuffer(view_of(camera), side=TILE, links=links, device=device)
        tiles = self._buffer.shape
        cells = tuple(TILE // CELL * count for count in tiles)
        self.seen = Occluders()
        self.seen.view, self.seen.changed = self._buffer.view, self._buffer.tiles
        self.seen.depths = wp.full(camera.size, NOWHERE, dtype=float, device=device)
        for name in ("peaks", "nearest", "least", "greatest"):
            setattr(self.seen, name, wp.full(cells, NOWHERE, dtype=float, device=device))

    def draw(self, geometry: Geometry) -> None:
        """Bring it up to date."""
        buffer, seen = self._buffer, self.seen
        buffer.draw(geometry)
        wp.launch(
            find_changes,
            buffer.shape,
            inputs=[int(buffer.everything), buffer.keys, seen.changed, seen.depths, seen.peaks,
                    seen.least, seen.greatest],
            device=self._device,
        )  # fmt: skip
        wp.launch(
            spread_peaks,
            buffer.shape,
            inputs=[self._spread, seen.changed, seen.peaks, seen.nearest],
            device=self._device,
        )


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
def lamp_limit(at: wp.vec3):
    """Depth [m] before which a sample hides the point of a `lamp_sample`."""
    return at[2] - SLACK


@wp.func
def lit_share(depths: wp.array2d(dtype=float), nearest: wp.array2d(dtype=float), at: wp.vec3):
    """Share of the lamp's light that arrives: a soft-edged box filter over its z-buffer.

    Args:
        at: `lamp_sample` of the point
    """
    if at[0] < 0.0:
        return 1.0
    x = at[0]
    y = at[1]
    c = int(x)
    r = int(y)
    limit = lamp_limit(at)
    if nearest[r / CELL, c / CELL] >= limit:
        return 1.0
    # most points are wholly lit or wholly dark: ask the filter's corners and centre first
    hidden = int(0)
    for i in range(-1, 2):
        for j in range(-1, 2):
            if i * i == j * j and depths[r + i * SOFT, c + j * SOFT] < limit:
                hidden += 1
    if hidden == 0:
        return 1.0
    if hidden == 5:
        return 0.0
    fx = x - float(c)
    fy = y - float(r)
    total = float(0.0)
    # SOFT to both sides and one more; literal, as only such loops are unrolled
    for i in range(-3, 5):
        wy = float(1.0)
        if i == -3:
            wy = 1.0 - fy
        if i == 4:
            wy = fy
        inner = int(0)
        for j in range(-2, 4):
            inner += int(depths[r + i, c + j] < limit)
        first = float(int(depths[r + i, c - 3] < limit))
        last = float(int(depths[r + i, c + 4] < limit))
        total += wy * (float(inner) + (1.0 - fx) * first + fx * last)
    width = float(2 * SOFT + 1)
    return 1.0 - total / (width * width)


@wp.func
def tap_reach(view: View, depth: float):
    """Samples between two of the taps of `open_share`."""
    # five taps reach 18 mm to either side
    return view.fx / depth * 0.009


@wp.func
def above_sample(view: View, p: wp.vec3, n: wp.vec3):
    """Column, row and depth [m] around which `open_share` looks; a negative column for nowhere."""
    q = to_camera(view, p + n * (OFFSET + 0.001))
    if q[2] < 0.1:
        return wp.vec3(-1.0, -1.0, 1.0)
    x = q[0] / q[2] * view.fx + view.cx + 0.5
    y = q[1] / q[2] * view.fy + view.cy + 0.5
    margin = float(TAPS) * tap_reach(view, q[2]) + 1.0
    if (
        x < margin
        or y < margin
        or x > float(view.columns) - margin
        or y > float(view.rows) - margin
    ):
        return wp.vec3(-1.0, -1.0, 1.0)
    return wp.vec3(x, y, q[2])


@wp.func
def above_limit(at: wp.vec3):
    """Depth [m] before which a sample takes light from an `above_sample`."""
    return at[2] - SLACK


@wp.func
def open_share(
    depths: wp.array2d(dtype=float), nearest: wp.array2d(dtype=float), at: wp.vec3, reach: float
):
    """Share of the ambient light that nearby things leave to a point, from the heights around it.

    Args:
        at: `above_sample` of the point
        reach: `tap_reach` there
    """
    if at[0] < 0.0:
        return 1.0
    x = at[0]
    y = at[1]
    limit = above_limit(at)
    if float(TAPS) * reach + 1.0 < float(ABOVE_SPREAD * CELL):
        if nearest[int(y) / CELL, int(x) / CELL] >= limit:
            return 1.0
    total = float(0.0)
    # TAPS to both sides; literal, as only such loops are unrolled
    for i in range(-2, 3):
        r = int(y + float(i) * reach)
        for j in range(-2, 3):
            depth = depths[r, int(x + float(j) * reach)]
            if depth < limit:
                rise = at[2] - depth
                total += rise / ((rise + 0.006) * (1.0 + rise * rise * 150.0))
    return 1.0 - total / 25.0
