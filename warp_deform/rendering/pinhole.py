"""Arithmetic of the pinhole z-buffer: which primitive every sample of a camera sees.

A sample (row, column) looks along the ray d = ((column - cx) / fx, (row - cy) / fy, 1) in the
camera's frame. The buffer's 64-bit keys hold the bits of the inverse depth above the primitive's
number, so an atomic maximum keeps the nearest surface whatever the order of threads; 0 is nothing.
A primitive's window is the rows and columns of its samples: r0, r1, c0, c1, both ends included. The
kernels fill the samples of marked tiles alone, squares of samples of which the buffer is made.

Source: Olano and Greer, "Triangle Scan Conversion using 2D Homogeneous Coordinates", 1997 (edge
functions from camera coordinates, so triangles need no clipping).
"""

from __future__ import annotations

import warp as wp

from .camera import Camera
from .geometry import Scene

__all__ = [
    "View",
    "inverse_depth",
    "link_window",
    "primitive_of",
    "raster_links",
    "raster_spheres",
    "raster_triangles",
    "ray",
    "sphere_window",
    "to_camera",
    "triangle_window",
    "view_of",
]

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

NEAR = wp.constant(0.01)  # [m], as the original's cameras


@wp.struct
class View:
    """A camera as kernels need it: axes in the world, origin [m], the rest in samples."""

    right: wp.vec3
    down: wp.vec3
    forward: wp.vec3
    origin: wp.vec3
    fx: float
    fy: float
    cx: float
    cy: float
    rows: int
    columns: int


def view_of(camera: Camera, *, supersample: int = 1) -> View:
    """The view of `camera` with `supersample` times as many samples as pixels along both axes."""
    view = View()
    pose, K = camera.world_T_camera, camera.intrinsics
    view.right, view.down, view.forward, view.origin = (wp.vec3(*pose[:3, k]) for k in range(4))
    view.fx, view.fy = K[0, 0] * supersample, K[1, 1] * supersample
    view.cx, view.cy = ((K[k, 2] + 0.5) * supersample - 0.5 for k in (0, 1))
    view.rows, view.columns = (side * supersample for side in camera.size)
    return view


@wp.func
def to_camera(view: View, p: wp.vec3):
    """A world point in the camera's frame."""
    d = p - view.origin
    return wp.vec3(wp.dot(view.right, d), wp.dot(view.down, d), wp.dot(view.forward, d))


@wp.func
def ray(view: View, row: float, column: float):
    """Direction through a sample in the camera's frame; its third component is 1."""
    return wp.vec3((column - view.cx) / view.fx, (row - view.cy) / view.fy, 1.0)


@wp.func
def key_of(inverse: float, primitive: int):
    """Pack a positive inverse depth and a primitive."""
    return (wp.int64(wp.cast(inverse, wp.int32)) << wp.int64(32)) | wp.int64(primitive + 1)


@wp.func
def inverse_depth(key: wp.int64):
    """Inverse depth [1/m] that a key holds; 0 for an empty one."""
    return wp.cast(int(key >> wp.int64(32)), float)


@wp.func
def primitive_of(key: wp.int64):
    """Primitive that a key holds; -1 for an empty one."""
    return int(key & wp.int64(0xFFFFFFFF)) - 1


@wp.func
def first_sample(x: float, count: int):
    """Lowest sample at or after `x`, between 0 and `count`."""
    return int(wp.clamp(wp.ceil(x), 0.0, float(count)))


@wp.func
def last_sample(x: float, count: int):
    """Highest sample at or before `x`, between -1 and `count` - 1."""
    return int(wp.clamp(wp.floor(x), -1.0, float(count) - 1.0))


@wp.func
def root_slope(view: View, slope: float):
    """By how many columns an edge function's root moves where its value at x = 0 grows by one."""
    if wp.abs(slope) < 1.0e-9:
        return 0.0
    return -view.fx / slope


@wp.func
def narrowed(slope: float, root: float, span: wp.vec2):
    """Part of the columns `span` where an edge function may not be negative, one more at its root.

    Args:
        slope: how it changes along the row
        root: the column where it is 0
    """
    if slope > 1.0e-9:
        return wp.vec2(wp.max(span[0], root - 1.0), span[1])
    if slope < -1.0e-9:
        return wp.vec2(span[0], wp.min(span[1], root + 1.0))
    return span


@wp.func
def touches(window: wp.vec4i, side: int, tiles: wp.array2d(dtype=int)):
    """Whether a window has a sample in a marked tile."""
    touched = bool(False)
    if window[0] <= window[1] and window[2] <= window[3]:
        i = window[0] / side
        # `while`, as a `for` of unknown bounds is slow
        while i <= window[1] / side and not touched:
            j = window[2] / side
            while j <= window[3] / side and not touched:
                touched = tiles[i, j] != 0
                j += 1
            i += 1
    return touched


@wp.func
def triangle_window(
    points: wp.array(dtype=wp.vec3),
    triangles: wp.array(dtype=wp.vec3i),
    closed: int,
    view: View,
    f: int,
):
    """Window of a triangle; the whole picture where it comes too near.

    Empty for one that belongs to a closed surface and is seen from its inside: another hides it.
    """
    tri = triangles[f]
    a = to_camera(view, points[tri[0]])
    b = to_camera(view, points[tri[1]])
    c = to_camera(view, points[tri[2]])
    if wp.max(a[2], wp.max(b[2], c[2])) < NEAR:
        return wp.vec4i(0, -1, 0, -1)
    if wp.min(a[2], wp.min(b[2], c[2])) <= NEAR:
        return wp.vec4i(0, view.rows - 1, 0, view.columns - 1)
    if closed == 1 and wp.dot(wp.cross(b - a, c - a), a) > 0.0:
        return wp.vec4i(0, -1, 0, -1)
    ax = a[0] / a[2]
    bx = b[0] / b[2]
    cx = c[0] / c[2]
    ay = a[1] / a[2]
    by = b[1] / b[2]
    cy = c[1] / c[2]
    return wp.vec4i(
        first_sample(wp.min(ay, wp.min(by, cy)) * view.fy + view.cy, view.rows),
        last_sample(wp.max(ay, wp.max(by, cy)) * view.fy + view.cy, view.rows),
        first_sample(wp.min(ax, wp.min(bx, cx)) * view.fx + view.cx, view.columns),
        last_sample(wp.max(ax, wp.max(bx, cx)) * view.fx + view.cx, view.columns),
    )


@wp.kernel
def raster_triangles(
    points: wp.array(dtype=wp.vec3),
    triangles: wp.array(dtype=wp.vec3i),
    view: View,
    windows: wp.array(dtype=wp.vec4i),
    side: int,
    tiles: wp.array2d(dtype=int),
    buffer: wp.array2d(dtype=wp.int64),
):
    """One thread a triangle."""
    f = wp.tid()
    window = windows[f]
    if not touches(window, side, tiles):
        return
    tri = triangles[f]
    a = to_camera(view, points[tri[0]])
    b = to_camera(view, points[tri[1]])
    c = to_camera(view, points[tri[2]])
    # edge functions; a shared edge gets the same numbers, negated, so there are no cracks
    ea = wp.cross(b, c)
    eb = wp.cross(c, a)
    ec = wp.cross(a, b)
    n = wp.cross(b - a, c - a)
    plane = wp.dot(n, a)
    # seen edge-on
    if wp.abs(plane) < 1.0e-12:
        return
    n = n / plane
    if plane < 0.0:
        ea = -ea
        eb = -eb
        ec = -ec
    step = 1.0 / view.fx
    root = wp.vec3(root_slope(view, ea[0]), root_slope(view, eb[0]), root_slope(view, ec[0]))
    i = window[0] / side
    while i <= window[1] / side:
        # from the first to the last marked tile of this row of tiles
        first = window[2] / side
        last = window[3] / side
        while first <= last and tiles[i, first] == 0:
            first += 1
        while first < last and tiles[i, last] == 0:
            last -= 1
        r = wp.max(window[0], i * side)
        bottom = wp.min(window[1], i * side + side - 1)
        if first > last:
            r = bottom + 1
        c0 = float(wp.max(window[2], first * side))
        c1 = float(wp.min(window[3], last * side + side - 1))
        while r <= bottom:
            y = (float(r) - view.cy) / view.fy
            ra = ea[1] * y + ea[2]
            rb = eb[1] * y + eb[2]
            rc = ec[1] * y + ec[2]
            rn = n[1] * y + n[2]
            # only where the row can be inside, and a sample more to both sides
            span = narrowed(ea[0], ra * root[0] + view.cx, wp.vec2(c0, c1))
            span = narrowed(eb[0], rb * root[1] + view.cx, span)
            span = narrowed(ec[0], rc * root[2] + view.cx, span)
            q = int(span[0])
            end = int(span[1])
            while q <= end:
                j = q / side
                stop = wp.min(end, j * side + side - 1)
                if tiles[i, j] == 0:
                    q = stop + 1
                while q <= stop:
                    x = (float(q) - view.cx) * step
                    if ea[0] * x + ra >= 0.0 and eb[0] * x + rb >= 0.0 and ec[0] * x + rc >= 0.0:
                        inverse = n[0] * x + rn
                        if inverse > 0.0 and inverse * NEAR < 1.0:
                            wp.atomic_max(buffer, r, q, key_of(inverse, f))
                    q += 1
            r += 1
        i += 1


@wp.func
def sphere_span(x: float, z: float, radius: float):
    """Smallest and largest x / z over a sphere in front of the camera (seen in one plane)."""
    span = radius * wp.sqrt(wp.max(x * x + z * z - radius * radius, 0.0))
    scale = 1.0 / (z * z - radius * radius)
    return wp.vec2((x * z - span) * scale, (x * z + span) * scale)


@wp.func
def sphere_window(centre: wp.vec3, radius: float, view: View):
    """Window of a sphere; empty unless all of it is ahead of the camera."""
    p = to_camera(view, centre)
    if p[2] - radius < NEAR:
        return wp.vec4i(0, -1, 0, -1)
    across = sphere_span(p[0], p[2], radius)
    along = sphere_span(p[1], p[2], radius)
    return wp.vec4i(
        first_sample(along[0] * view.fy + view.cy, view.rows),
        last_sample(along[1] * view.fy + view.cy, view.rows),
        first_sample(across[0] * view.fx + view.cx, view.columns),
        last_sample(across[1] * view.fx + view.cx, view.columns),
    )


@wp.kernel
def raster_spheres(
    scene: Scene,
    view: View,
    windows: wp.array(dtype=wp.vec4i),
    side: int,
    tiles: wp.array2d(dtype=int),
    first: int,
    buffer: wp.array2d(dtype=wp.int64),
):
    """One thread a sphere; `first` primitives come before the spheres."""
    s = wp.tid()
    window = windows[first + s]
    if not touches(window, side, tiles):
        return
    radius = scene.sphere_radius[s]
    p = to_camera(view, scene.points[scene.sphere_particle[s]])
    for r in range(window[0], window[1] + 1):
        for q in range(window[2], window[3] + 1):
            if tiles[r / side, q / side] != 0:
                d = ray(view, float(r), float(q))
                square = wp.dot(d, d)
                # the ray's closest point to the centre; subtracting squares instead loses digits
                nearest = wp.dot(d, p) / square
                gap = d * nearest - p
                inside = radius * radius - wp.dot(gap, gap)
                if inside > 0.0:
                    wp.atomic_max(
                        buffer, r, q, key_of(1.0 / (nearest - wp.sqrt(inside / square)), first + s)
                    )


@wp.func
def link_window(start: wp.vec3, end: wp.vec3, radius: float, view: View):
    """Window of a rod; empty unless all of it is ahead of the camera."""
    a = to_camera(view, start)
    b = to_camera(view, end)
    if wp.min(a[2], b[2]) - radius < NEAR or wp.length(b - a) < 1.0e-9:
        return wp.vec4i(0, -1, 0, -1)
    xa = sphere_span(a[0], a[2], radius)
    xb = sphere_span(b[0], b[2], radius)
    ya = sphere_span(a[1], a[2], radius)
    yb = sphere_span(b[1], b[2], radius)
    return wp.vec4i(
        first_sample(wp.min(ya[0], yb[0]) * view.fy + view.cy, view.rows),
        last_sample(wp.max(ya[1], yb[1]) * view.fy + view.cy, view.rows),
        first_sample(wp.min(xa[0], xb[0]) * view.fx + view.cx, view.columns),
        last_sample(wp.max(xa[1], xb[1]) * view.fx + view.cx, view.columns),
    )


@wp.kernel
def raster_links(
    scene: Scene,
    view: View,
    windows: wp.array(dtype=wp.vec4i),
    side: int,
    tiles: wp.array2d(dtype=int),
    first: int,
    buffer: wp.array2d(dtype=wp.int64),
):
    """One thread a rod: a cylinder without caps, as its ends lie inside of beads."""
    k = wp.tid()
    window = windows[first + k]
    if not touches(window, side, tiles):
        return
    radius = scene.link_radius[k]
    ends = scene.link_particle[k]
    a = to_camera(view, scene.points[ends[0]])
    b = to_camera(view, scene.points[ends[1]])
    length = wp.length(b - a)
    axis = (b - a) / length
    flat_a = a - axis * wp.dot(axis, a)
    for r in range(window[0], window[1] + 1):
        for q in range(window[2], window[3] + 1):
            if tiles[r / side, q / side] != 0:
                d = ray(view, float(r), float(q))
                # seen along the axis, the rod is a disc
                flat_d = d - axis * wp.dot(axis, d)
                square = wp.dot(flat_d, flat_d)
                if square > 1.0e-12:
                    nearest = wp.dot(flat_d, flat_a) / square
                    gap = flat_d * nearest - flat_a
                    inside = radius * radius - wp.dot(gap, gap)
                    if inside > 0.0:
                        depth = nearest - wp.sqrt(inside / square)
                        along = wp.dot(axis, d * depth - a)
                        if depth > NEAR and along >= 0.0 and along <= length:
                            wp.atomic_max(buffer, r, q, key_of(1.0 / depth, first + k))
