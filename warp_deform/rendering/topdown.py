"""Orthographic top-down pictures of the table: colour, height and segmentation.

A z-buffer holds one 64-bit key a sample: the height's bits above the number of the primitive, so an
atomic maximum keeps the highest surface and breaks ties by number, whatever the order of threads.
Samples lie twice as dense as pixels; every pixel's centre is one of them. Height and segmentation
are read there, colour is a tent filter over the sample and its eight neighbours.
"""

from __future__ import annotations

from weakref import WeakKeyDictionary

import numpy as np
import warp as wp

from ..objects.colors import TABLE
from .drawables import WORKSPACE_SEGMENT, Drawables
from .geometry import Geometry, HostArray, Scene
from .images import Images
from .pixels import BOUNDS, PIXEL_SIZE, SHAPE

__all__ = ["TopDown"]

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# One sample more than two a pixel: the filter of the first row and column reaches half a pixel out.
ROWS = wp.constant(2 * SHAPE[0] + 1)
COLUMNS = wp.constant(2 * SHAPE[1] + 1)
DENSITY = wp.constant(2.0 / PIXEL_SIZE)  # samples per metre
# sample (row, column) is at x = (column - X0) / DENSITY, y = (row - Y0) / DENSITY
X0 = wp.constant(1.0 - 2.0 * BOUNDS[0][0] / PIXEL_SIZE)
Y0 = wp.constant(1.0 - 2.0 * BOUNDS[1][0] / PIXEL_SIZE)
TABLE_ID = wp.constant(WORKSPACE_SEGMENT)
BACKGROUND = wp.constant(wp.vec3(*(float(c) for c in TABLE)))
AMBIENT = wp.constant(0.35)
# Towards the light, scaled so that a level surface has its palette's colour.
LIGHT = wp.constant(wp.vec3(-0.3, 0.3, 1.0))
LOWER_BITS = wp.constant(wp.int64(0xFFFFFFFF))
# Barycentric coordinates this far outside still count, so that rounding opens no cracks.
EDGE = wp.constant(-1.0e-6)


@wp.func
def key_of(z: float, primitive: int):
    """Pack a positive height and a primitive: bits of positive floats order like the numbers."""
    return (wp.int64(wp.cast(z, wp.int32)) << wp.int64(32)) | wp.int64(primitive + 1)


@wp.func
def brightness(n: wp.vec3, length: float):
    """Lambert's law for a normal of any `length`, at most 1."""
    cosine = wp.max(wp.dot(n, LIGHT), 0.0) / length
    return wp.min(AMBIENT + (1.0 - AMBIENT) * cosine, 1.0)


@wp.kernel
def raster_triangles(
    scene: Scene, color: wp.array(dtype=wp.vec3), buffer: wp.array2d(dtype=wp.int64)
):
    """One thread a triangle: its flat colour, and its heights at the samples it covers."""
    f = wp.tid()
    tri = scene.triangles[f]
    a = scene.points[tri[0]]
    b = scene.points[tri[1]]
    c = scene.points[tri[2]]
    n = wp.cross(b - a, c - a)
    if n[2] < 0.0:
        n = -n
    # seen edge-on
    if n[2] < 1.0e-9:
        return
    color[f] = scene.palette[scene.triangle_material[f]] * brightness(n, wp.length(n))
    ax = a[0] * DENSITY + X0
    ay = a[1] * DENSITY + Y0
    bx = b[0] * DENSITY + X0
    by = b[1] * DENSITY + Y0
    cx = c[0] * DENSITY + X0
    cy = c[1] * DENSITY + Y0
    columns = float(COLUMNS)
    rows = float(ROWS)
    c0 = int(wp.clamp(wp.ceil(wp.min(ax, wp.min(bx, cx))), 0.0, columns))
    c1 = int(wp.clamp(wp.floor(wp.max(ax, wp.max(bx, cx))), -1.0, columns - 1.0))
    r0 = int(wp.clamp(wp.ceil(wp.min(ay, wp.min(by, cy))), 0.0, rows))
    r1 = int(wp.clamp(wp.floor(wp.max(ay, wp.max(by, cy))), -1.0, rows - 1.0))
    scale = 1.0 / ((bx - ax) * (cy - ay) - (cx - ax) * (by - ay))
    for r in range(r0, r1 + 1):
        y = float(r)
        for q in range(c0, c1 + 1):
            x = float(q)
            v = ((x - ax) * (cy - ay) - (cx - ax) * (y - ay)) * scale
            w = ((bx - ax) * (y - ay) - (x - ax) * (by - ay)) * scale
            if v >= EDGE and w >= EDGE and 1.0 - v - w >= EDGE:
                z = a[2] + v * (b[2] - a[2]) + w * (c[2] - a[2])
                if z > 0.0:
                    wp.atomic_max(buffer, r, q, key_of(z, f))


@wp.kernel
def raster_spheres(scene: Scene, first: int, buffer: wp.array2d(dtype=wp.int64)):
    """One thread a sphere."""
    s = wp.tid()
    p = scene.points[scene.sphere_particle[s]]
    radius = scene.sphere_radius[s]
    reach = radius * DENSITY
    x = p[0] * DENSITY + X0
    y = p[1] * DENSITY + Y0
    c0 = int(wp.clamp(wp.ceil(x - reach), 0.0, float(COLUMNS)))
    c1 = int(wp.clamp(wp.floor(x + reach), -1.0, float(COLUMNS) - 1.0))
    r0 = int(wp.clamp(wp.ceil(y - reach), 0.0, float(ROWS)))
    r1 = int(wp.clamp(wp.floor(y + reach), -1.0, float(ROWS) - 1.0))
    for r in range(r0, r1 + 1):
        dy = (float(r) - y) / DENSITY
        for q in range(c0, c1 + 1):
            dx = (float(q) - x) / DENSITY
            square = radius * radius - dx * dx - dy * dy
            if square > 0.0:
                z = p[2] + wp.sqrt(square)
                if z > 0.0:
                    wp.atomic_max(buffer, r, q, key_of(z, first + s))


@wp.func
def color_at(
    scene: Scene,
    color: wp.array(dtype=wp.vec3),
    buffer: wp.array2d(dtype=wp.int64),
    triangles: int,
    r: int,
    q: int,
):
    """Colour of one sample, 0 to 255."""
    key = buffer[r, q]
    if key == wp.int64(0):
        return BACKGROUND
    primitive = int(key & LOWER_BITS) - 1
    if primitive < triangles:
        return color[primitive]
    s = primitive - triangles
    p = scene.points[scene.sphere_particle[s]]
    z = wp.cast(int(key >> wp.int64(32)), float)
    n = wp.vec3((float(q) - X0) / DENSITY - p[0], (float(r) - Y0) / DENSITY - p[1], z - p[2])
    return scene.palette[scene.sphere_material[s]] * brightness(n, scene.sphere_radius[s])


@wp.kernel
def resolve(
    scene: Scene,
    color: wp.array(dtype=wp.vec3),
    buffer: wp.array2d(dtype=wp.int64),
    triangles: int,
    out_color: wp.array2d(dtype=wp.vec3ub),
    out_height: wp.array2d(dtype=float),
    out_segmentation: wp.array2d(dtype=wp.uint8),
):
    """One thread a pixel: filtered colour, height and segmentation at its centre."""
    u, v = wp.tid()
    r = 2 * u + 1
    q = 2 * v + 1
    anything = buffer[r, q]
    for i in range(-1, 2):
        for j in range(-1, 2):
            anything = anything | buffer[r + i, q + j]
    if anything == wp.int64(0):
        out_color[u, v] = wp.vec3ub(
            wp.uint8(BACKGROUND[0]), wp.uint8(BACKGROUND[1]), wp.uint8(BACKGROUND[2])
        )
        out_height[u, v] = 0.0
        out_segmentation[u, v] = wp.uint8(TABLE_ID)
        return
    total = wp.vec3(0.5, 0.5, 0.5)
    for i in range(-1, 2):
        for j in range(-1, 2):
            weight = float((2 - i * i) * (2 - j * j)) / 16.0
            total += weight * color_at(scene, color, buffer, triangles, r + i, q + j)
    out_color[u, v] = wp.vec3ub(wp.uint8(total[0]), wp.uint8(total[1]), wp.uint8(total[2]))
    key = buffer[r, q]
    height = float(0.0)
    segment = TABLE_ID
    if key != wp.int64(0):
        height = wp.cast(int(key >> wp.int64(32)), float)
        primitive = int(key & LOWER_BITS) - 1
        if primitive < triangles:
            segment = scene.triangle_material[primitive]
        else:
            segment = scene.sphere_material[primitive - triangles]
    out_height[u, v] = height
    out_segmentation[u, v] = wp.uint8(segment)


class TopDown:
    """Draws top-down pictures; keeps its buffers, so make one and use it again.

    An instance is for one thread at a time. The background is the bare table: (51, 51, 51), height
    0, segmentation 1. Nothing below the table's surface is drawn.
    """

    def __init__(self, *, device: str = "cpu") -> None:
        self._device = wp.get_device(device)
        self._buffer = wp.zeros((ROWS, COLUMNS), dtype=wp.int64, device=self._device)
        self._color = HostArray(SHAPE, wp.vec3ub, self._device)
        self._height = HostArray(SHAPE, wp.float32, self._device)
        self._segmentation = HostArray(SHAPE, wp.uint8, self._device)
        self._scenes: WeakKeyDictionary[Drawables, tuple[Geometry, list[wp.Launch]]] = (
            WeakKeyDictionary()
        )

    def render(self, drawables: Drawables, particle_q: np.ndarray, body_q: np.ndarray) -> Images:
        """Pictures of one world.

        Args:
            particle_q: positions of the particles (P, 3) [m]
            body_q: poses of the bodies (B, 7), position [m] and quat_xyzw

        Raises:
            InputError: the state is not finite or has fewer particles or bodies than are drawn.
        """
        geometry, launches = self._scene(drawables, len(particle_q), len(body_q))
        geometry.move(particle_q, body_q)
        self._buffer.zero_()
        for launch in launches:
            launch.launch()
        return Images(
            color=self._color.read(),
            height=self._height.read(),
            segmentation=self._segmentation.read(),
        )

    def _scene(
        self, drawables: Drawables, particles: int, bodies: int
    ) -> tuple[Geometry, list[wp.Launch]]:
        cached = self._scenes.get(drawables)
        if cached and (cached[0].particle_count, cached[0].body_count) == (particles, bodies):
            return cached
        geometry = Geometry(drawables, particles, bodies, self._device)
        triangles, scene = geometry.triangle_count, geometry.scene
        color = wp.zeros(triangles, dtype=wp.vec3, device=self._device)
        passes = [
            (raster_triangles, triangles, [scene, color, self._buffer]),
            (raster_spheres, geometry.sphere_count, [scene, triangles, self._buffer]),
            (
                resolve,
                SHAPE,
                [scene, color, self._buffer, triangles, self._color.array, self._height.array,
                 self._segmentation.array],
            ),
        ]  # fmt: skip
        launches = [
            wp.launch(kernel, dim, inputs=inputs, device=self._device, record_cmd=True)
            for kernel, dim, inputs in passes
            if dim != 0
        ]
        self._scenes[drawables] = geometry, launches
        return geometry, launches
