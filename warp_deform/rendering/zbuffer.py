"""A z-buffer that is drawn again only where something changed.

The buffer is cut into square tiles. Every primitive remembers its window; one that changed marks
the tiles of the window it had and of the one it has. Marked tiles are emptied and every primitive
that reaches into them is drawn there, the others keep what a drawing of everything would give them.
"""

from __future__ import annotations

import warp as wp

from .geometry import Geometry, Scene
from .pinhole import (
    View,
    link_window,
    raster_links,
    raster_spheres,
    raster_triangles,
    sphere_window,
    triangle_window,
)

__all__ = ["ZBuffer"]

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
def mark(window: wp.vec4i, side: int, tiles: wp.array2d(dtype=int)):
    """Mark the tiles of a window."""
    if window[0] <= window[1] and window[2] <= window[3]:
        i = window[0] / side
        while i <= window[1] / side:
            j = window[2] / side
            while j <= window[3] / side:
                tiles[i, j] = 1
                j += 1
            i += 1


@wp.kernel
def mark_changes(
    scene: Scene,
    view: View,
    everything: int,
    changed: wp.array(dtype=int),
    spheres: int,
    links: int,
    side: int,
    windows: wp.array(dtype=wp.vec4i),
    tiles: wp.array2d(dtype=int),
):
    """One thread a primitive: keep its window, and mark tiles where it changed.

    Args:
        spheres: primitives before them
        links: primitives before them
        everything: windows are unknown, and tiles marked
    """
    i = wp.tid()
    if everything == 0:
        if changed[i] == 0:
            return
        mark(windows[i], side, tiles)
    window = wp.vec4i(0, -1, 0, -1)
    if i < spheres:
        window = triangle_window(scene.points, scene.triangles, scene.triangle_closed[i], view, i)
    elif i < links:
        s = i - spheres
        centre = scene.points[scene.sphere_particle[s]]
        window = sphere_window(centre, scene.sphere_radius[s], view)
    else:
        ends = scene.link_particle[i - links]
        radius = scene.link_radius[i - links]
        window = link_window(scene.points[ends[0]], scene.points[ends[1]], radius, view)
    windows[i] = window
    if everything == 0:
        mark(window, side, tiles)


@wp.kernel
def empty(
    side: int,
    tiles: wp.array2d(dtype=int),
    keys: wp.array2d(dtype=wp.int64),
):
    """One thread a tile: empty it if it is marked."""
    i, j = wp.tid()
    if tiles[i, j] != 0:
        r = i * side
        while r < wp.min((i + 1) * side, keys.shape[0]):
            c = j * side
            while c < wp.min((j + 1) * side, keys.shape[1]):
                keys[r, c] = wp.int64(0)
                c += 1
            r += 1


class ZBuffer:
    """What a view sees of a geometry, sample by sample.

    `keys` (rows, columns) int64 say what is seen; `tiles` are 1 where the last drawing changed
    something, and `everything` says whether it was drawn whole.

    Args:
        view: from where
        side: samples along a tile's side
        links: whether rods are drawn
    """

    def __init__(self, view: View, *, side: int, links: bool, device: wp.Device) -> None:
        self.view, self.side, self._links, self._device = view, side, links, device
        self.keys = wp.zeros((view.rows, view.columns), dtype=wp.int64, device=device)
        self.everything = True
        self.shape = -(-view.rows // side), -(-view.columns // side)
        self.tiles = wp.zeros(self.shape, dtype=wp.int32, device=device)
        self._windows = wp.zeros(0, dtype=wp.vec4i, device=device)
        self._shows: int | None = None

    def draw(self, geometry: Geometry) -> None:
        """Bring the buffer up to date.

        Only what changed is drawn when the last drawing was of the geometry's previous state.
        Primitives count triangles first, then spheres, then rods.
        """
        everything = self._shows is None or self._shows != geometry.previous_state
        self.everything = everything
        self._shows = None  # until it is whole
        scene, device, side = geometry.scene, self._device, self.side
        spheres = geometry.triangle_count
        links = spheres + geometry.sphere_count
        count = links + (geometry.link_count if self._links else 0)
        self.tiles.fill_(int(everything))
        if self._windows.shape[0] != count:
            self._windows = wp.zeros(count, dtype=wp.vec4i, device=device)
        wp.launch(
            mark_changes,
            count,
            inputs=[scene, self.view, int(everything), geometry.changed, spheres, links, side,
                    self._windows, self.tiles],
            device=device,
        )  # fmt: skip
        if everything:
            self.keys.zero_()
        else:
            wp.launch(empty, self.shape, inputs=[side, self.tiles, self.keys], device=device)
        where = [scene, self.view, self._windows, side, self.tiles]
        for kernel, dim, inputs in (
            (raster_triangles, spheres, [scene.points, scene.triangles, *where[1:], self.keys]),
            (raster_spheres, geometry.sphere_count, [*where, spheres, self.keys]),
            (raster_links, count - links, [*where, links, self.keys]),
        ):
            if dim:
                wp.launch(kernel, dim, inputs=inputs, device=device)
        self._shows = geometry.state
