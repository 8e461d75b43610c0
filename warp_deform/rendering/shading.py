"""What a sample's surface looks like: materials, floor, a lamp with soft shadows, ambient light.

Light adds up in linear colour, taken as the square of the stored one, so the shader needs no
transcendental function. A level surface in full light in the table's middle has its own colour.
"""

from __future__ import annotations

from dataclasses import dataclass

import warp as wp

from ..objects.colors import TABLE, Color
from .drawables import WORKSPACE_SEGMENT
from .geometry import MESH_MATERIAL, Scene
from .occlusion import (
    SOFT,
    TAPS,
    Occluders,
    above_limit,
    above_sample,
    lamp_limit,
    lamp_sample,
    lit_share,
    open_share,
    tap_reach,
)
from .patches import PATCH, SIDE, keep_looks, look, no_look
from .pinhole import View, inverse_depth, primitive_of, ray, to_camera
from .pixels import BOUNDS

__all__ = ["FLOOR_SEGMENT", "ROBOT_SEGMENT", "Lighting", "Look", "lighting_of", "shade"]

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

FLOOR_SEGMENT = 0
ROBOT_SEGMENT = 2
"""Segmentation ids of the floor and of every mesh, as in the original."""

FIRST_MESH = wp.constant(MESH_MATERIAL)
ROBOT = wp.constant(ROBOT_SEGMENT)
WORKSPACE = wp.constant(WORKSPACE_SEGMENT)
X_LOW, X_HIGH = (wp.constant(value) for value in BOUNDS[0])
Y_LOW, Y_HIGH = (wp.constant(value) for value in BOUNDS[1])
TABLE_COLOR = wp.constant(wp.vec3(*(float(c) for c in TABLE)))
NOTHING = wp.constant(-1)
PATCH_SIDE = wp.constant(PATCH)


@dataclass(frozen=True, kw_only=True)
class Look:
    """Surroundings and light; colours are 8-bit RGB."""

    floor: float = -0.001
    """Height of the floor [m]."""
    floor_color: Color = (239, 239, 239)
    floor_checker: Color = (158, 181, 224)
    """Colour of every other square of 1 m; the same as `floor_color` for a plain floor."""
    table: bool = True
    """Whether the workspace is painted on the plane z = 0."""
    horizon: Color = (178, 178, 204)
    """Colour of what lies beyond the floor."""
    haze: float = 0.0
    """Distance at which the floor has half taken the horizon's colour [m]; 0 for never."""
    lamp: tuple[float, float, float] = (0.1, -1.1, 2.4)
    """Where the lamp hangs [m]."""
    lamp_share: float = 0.62
    """Share of the light on a level surface that comes from the lamp; the rest is ambient."""
    occlusion: float = 0.0
    """How strongly things above keep ambient light out, 0 to 1."""
    gloss: float = 0.0
    """Strength of highlights on meshes; objects have a third of it."""


@wp.struct
class Lighting:
    """A `Look` as the kernel reads it; linear colours."""

    floor: float
    floor_color: wp.vec3
    floor_checker: wp.vec3
    table: int
    horizon: wp.vec3
    haze: float
    lamp: wp.vec3
    direct: float
    ambient: float
    occlusion: float
    gloss: float


@wp.struct
class Surface:
    """What one sample sees."""

    position: wp.vec3
    normal: wp.vec3
    color: wp.vec3
    gloss: float
    depth: float
    segment: int


def linear(color: Color) -> wp.vec3:
    """Linear colour, 0 to 1, of an 8-bit one."""
    return wp.vec3(*((c / 255) ** 2 for c in color))


def lighting_of(look: Look) -> Lighting:
    """The kernel's form of `look`."""
    lighting = Lighting()
    lighting.floor, lighting.table = look.floor, int(look.table)
    lighting.floor_color = linear(look.floor_color)
    lighting.floor_checker = linear(look.floor_checker)
    lighting.horizon, lighting.haze = linear(look.horizon), look.haze
    lighting.lamp = wp.vec3(*look.lamp)
    x, y, z = look.lamp
    cosine = z / ((x - 0.5) ** 2 + y**2 + z**2) ** 0.5
    lighting.direct, lighting.ambient = look.lamp_share / cosine, 1.0 - look.lamp_share
    lighting.occlusion, lighting.gloss = look.occlusion, look.gloss
    return lighting


@wp.func
def squared(c: wp.vec3):
    """Linear colour of a stored one, 0 to 255."""
    return wp.cw_mul(c, c) * (1.0 / 65025.0)


@wp.func
def world_ray(view: View, row: float, column: float):
    """Direction through a sample in the world, of unit depth."""
    d = ray(view, row, column)
    return view.right * d[0] + view.down * d[1] + view.forward


@wp.func
def ground(lighting: Lighting, view: View, row: float, column: float):
    """Table, floor or horizon at a sample that sees no primitive."""
    d = world_ray(view, row, column)
    s = Surface()
    s.normal = wp.vec3(0.0, 0.0, 1.0)
    s.gloss = 0.0
    s.segment = NOTHING
    s.color = lighting.horizon
    s.depth = 0.0
    if d[2] > -1.0e-6:
        return s
    if lighting.table == 1:
        depth = -view.origin[2] / d[2]
        p = view.origin + d * depth
        if depth > 0.0 and p[0] >= X_LOW and p[0] <= X_HIGH and p[1] >= Y_LOW and p[1] <= Y_HIGH:
            s.position = p
            s.depth = depth
            s.segment = WORKSPACE
            s.color = squared(TABLE_COLOR)
            return s
    depth = (lighting.floor - view.origin[2]) / d[2]
    if depth > 0.0:
        p = view.origin + d * depth
        s.position = p
        s.depth = depth
        s.segment = 0
        s.color = lighting.floor_color
        if (int(wp.floor(p[0])) + int(wp.floor(p[1]))) % 2 != 0:
            s.color = lighting.floor_checker
    return s


@wp.func
def on_triangle(
    points: wp.array(dtype=wp.vec3),
    triangles: wp.array(dtype=wp.vec3i),
    normals: wp.array2d(dtype=wp.vec3),
    origin: wp.vec3,
    f: int,
    d: wp.vec3,
):
    """Normal of a triangle where the ray `d` from `origin` meets it, and the depth there."""
    tri = triangles[f]
    a = points[tri[0]] - origin
    ab = points[tri[1]] - origin - a
    ac = points[tri[2]] - origin - a
    n = wp.cross(ab, ac)
    depth = wp.dot(n, a) / wp.dot(n, d)
    ap = d * depth - a
    scale = 1.0 / wp.dot(n, n)
    wb = wp.clamp(wp.dot(wp.cross(ap, ac), n) * scale, 0.0, 1.0)
    wc = wp.clamp(wp.dot(wp.cross(ab, ap), n) * scale, 0.0, 1.0)
    wa = wp.max(1.0 - wb - wc, 0.0)
    normal = wp.normalize(normals[f, 0] * wa + normals[f, 1] * wb + normals[f, 2] * wc)
    return normal, depth


@wp.func
def on_sphere(centre: wp.vec3, radius: float, view: View, d: wp.vec3, world_d: wp.vec3):
    """Normal of a sphere where the ray `d`, `world_d` in the world, meets it; the depth there."""
    p = to_camera(view, centre)
    square = wp.dot(d, d)
    nearest = wp.dot(d, p) / square
    gap = d * nearest - p
    depth = nearest - wp.sqrt(wp.max(radius * radius - wp.dot(gap, gap), 0.0) / square)
    return wp.normalize(view.origin + world_d * depth - centre), depth


@wp.func
def on_link(start: wp.vec3, end: wp.vec3, view: View, depth: float, world_d: wp.vec3):
    """Normal of a rod at a depth along the world's ray `world_d`."""
    axis = wp.normalize(end - start)
    p = view.origin + world_d * depth - start
    return wp.normalize(p - axis * wp.dot(axis, p))


@wp.func
def surface_at(
    scene: Scene,
    view: View,
    lighting: Lighting,
    triangles: int,
    spheres: int,
    key: wp.int64,
    row: float,
    column: float,
):
    """The surface of the primitive in `key` where the ray through (row, column) meets it.

    An array that is a structure's member is copied at every use, so each is handed on once.
    """
    d = ray(view, row, column)
    world_d = world_ray(view, row, column)
    primitive = primitive_of(key)
    s = Surface()
    material = int(0)
    if primitive < triangles:
        normal, depth = on_triangle(
            scene.points, scene.triangles, scene.triangle_normals, view.origin, primitive, world_d
        )
        s.normal = normal
        s.depth = depth
        material = scene.triangle_material[primitive]
    elif primitive < triangles + spheres:
        k = primitive - triangles
        centre = scene.points[scene.sphere_particle[k]]
        normal, depth = on_sphere(centre, scene.sphere_radius[k], view, d, world_d)
        s.normal = normal
        s.depth = depth
        material = scene.sphere_material[k]
    else:
        k = primitive - triangles - spheres
        s.depth = 1.0 / inverse_depth(key)
        ends = scene.link_particle[k]
        s.normal = on_link(scene.points[ends[0]], scene.points[ends[1]], view, s.depth, world_d)
        material = scene.link_material[k]
    if wp.dot(s.normal, world_d) > 0.0:
        s.normal = -s.normal
    s.position = view.origin + world_d * s.depth
    s.color = squared(scene.palette[material])
    s.gloss = lighting.gloss
    s.segment = ROBOT
    if material < FIRST_MESH:
        s.segment = material
        s.gloss = lighting.gloss / 3.0
    return s


@wp.func
def radiance(s: Surface, view: View, lighting: Lighting, lamp: Occluders, above: Occluders):
    """Linear colour that a surface sends to the camera; bounds of its looks at lamp and above."""
    lamp_look = no_look()
    above_look = no_look()
    color = s.color
    if s.segment != NOTHING:
        to_lamp = wp.normalize(lighting.lamp - s.position)
        cosine = wp.dot(s.normal, to_lamp)
        direct = float(0.0)
        highlight = float(0.0)
        if cosine > 0.0:
            at = lamp_sample(lamp.view, s.position, s.normal)
            seen = lit_share(lamp.depths, lamp.nearest, at)
            limit = lamp_limit(at)
            lamp_look = look(at, float(SOFT) + 1.0, limit, limit)
            direct = lighting.direct * cosine * seen
            if s.gloss * seen > 0.0:
                half = wp.normalize(to_lamp + wp.normalize(view.origin - s.position))
                h = wp.max(wp.dot(s.normal, half), 0.0)
                h = h * h
                h = h * h
                h = h * h
                h = h * h
                highlight = s.gloss * seen * h * h
        # the sky is bright, the floor throws a little back
        ambient = lighting.ambient * (0.7 + 0.3 * s.normal[2])
        if lighting.occlusion > 0.0:
            around = above_sample(above.view, s.position, s.normal)
            reach = tap_reach(above.view, around[2])
            closed = 1.0 - open_share(above.depths, above.nearest, around, reach)
            above_look = look(around, float(TAPS) * reach, 0.0, above_limit(around))
            ambient = ambient * wp.max(1.0 - lighting.occlusion * closed, 0.0)
        color = s.color * (direct + ambient) + wp.vec3(highlight, highlight, highlight)
        if s.segment == 0 and lighting.haze > 0.0:
            gap = s.position - view.origin
            ratio = wp.dot(gap, gap) / (lighting.haze * lighting.haze)
            color = wp.lerp(color, lighting.horizon, ratio / (1.0 + ratio))
    return color, lamp_look, above_look


@wp.kernel
def shade(
    scene: Scene,
    view: View,
    lighting: Lighting,
    supersample: int,
    triangles: int,
    spheres: int,
    far: float,
    buffer: wp.array2d(dtype=wp.int64),
    lamp: Occluders,
    above: Occluders,
    patches: wp.array(dtype=int),
    patch_columns: int,
    looks: wp.array2d(dtype=int),
    out_color: wp.array2d(dtype=wp.vec3ub),
    out_depth: wp.array2d(dtype=float),
    out_segmentation: wp.array2d(dtype=wp.uint8),
):
    """One thread a listed patch: the mean of each pixel's samples.

    A pixel whose samples all see one primitive is shaded once. Depth and segmentation are whole
    only with one sample a pixel.
    """
    n = wp.tid()
    patch = patches[n]
    top = patch / patch_columns * PATCH_SIDE
    left = patch % patch_columns * PATCH_SIDE
    lamp_looks = no_look()
    above_looks = no_look()
    # `while`, as a `for` of unknown bounds is slow
    pixel = int(-1)
    while pixel < PATCH_SIDE * PATCH_SIDE - 1:
        pixel += 1
        i = top + pixel / PATCH_SIDE
        j = left + pixel % PATCH_SIDE
        if i >= out_color.shape[0] or j >= out_color.shape[1]:
            continue
        r0 = i * supersample
        c0 = j * supersample
        key = buffer[r0, c0]
        same = bool(True)
        r = r0
        while r < r0 + supersample:
            c = c0
            while c < c0 + supersample:
                same = same and primitive_of(buffer[r, c]) == primitive_of(key)
                c += 1
            r += 1
        # the table is painted where no primitive is, so its edge may go through a pixel of them
        same = same and (supersample == 1 or lighting.table == 0 or key != wp.int64(0))
        rows = wp.where(same, 1, supersample)
        middle = wp.where(same, 0.5 * float(supersample - 1), 0.0)
        total = wp.vec3(0.0, 0.0, 0.0)
        a = int(0)
        while a < rows * rows:
            r = r0 + a / rows
            c = c0 + a % rows
            key = buffer[r, c]
            row = float(r) + middle
            column = float(c) + middle
            # apart from each other, as handing over the whole scene costs more than the floor does
            s = Surface()
            if key == wp.int64(0):
                s = ground(lighting, view, row, column)
            else:
                s = surface_at(scene, view, lighting, triangles, spheres, key, row, column)
            color, lamp_look, above_look = radiance(s, view, lighting, lamp, above)
            total += color
            lamp_looks = wp.min(lamp_looks, lamp_look)
            above_looks = wp.min(above_looks, above_look)
            if same:
                out_depth[i, j] = wp.where(s.segment == NOTHING or s.depth > far, far, s.depth)
                out_segmentation[i, j] = wp.uint8(wp.max(s.segment, 0))
            a += 1
        total = total / float(rows * rows)
        out_color[i, j] = wp.vec3ub(
            wp.uint8(wp.sqrt(wp.min(total[0], 1.0)) * 255.0 + 0.5),
            wp.uint8(wp.sqrt(wp.min(total[1], 1.0)) * 255.0 + 0.5),
            wp.uint8(wp.sqrt(wp.min(total[2], 1.0)) * 255.0 + 0.5),
        )
    keep_looks(lamp_looks, patch, 0, looks)
    keep_looks(above_looks, patch, SIDE, looks)
