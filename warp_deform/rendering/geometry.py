"""One world's triangles, spheres and rods on a device, moved to where the state says they are.

Every triangle, whatever it belongs to, has its corners in one array of world points:
particles | box corners | flat marks | corners of meshes. So a rasteriser knows three primitives.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from ..errors import InputError
from .drawables import Drawables
from .meshes import BOX_FACES, Mesh

__all__ = ["MESH_MATERIAL", "Geometry", "HostArray", "Scene"]

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

MESH_MATERIAL = 256
"""Materials below this are segmentation ids; those from here on are the meshes', in their order."""

_STATES = itertools.count()


@wp.struct
class Scene:
    """What the rasterisers read; world coordinates [m]."""

    points: wp.array(dtype=wp.vec3)
    triangles: wp.array(dtype=wp.vec3i)
    triangle_material: wp.array(dtype=int)
    triangle_closed: wp.array(dtype=int)  # 1 on closed surfaces, whose inside nobody sees
    triangle_normals: wp.array2d(dtype=wp.vec3)  # (triangles, 3), per corner; scenes only
    sphere_particle: wp.array(dtype=int)
    sphere_radius: wp.array(dtype=float)
    sphere_material: wp.array(dtype=int)
    link_particle: wp.array(dtype=wp.vec2i)
    link_radius: wp.array(dtype=float)
    link_material: wp.array(dtype=int)
    palette: wp.array(dtype=wp.vec3)  # (256 + meshes,), 0 to 255


@wp.kernel
def place_boxes(
    first: int,
    body_q: wp.array(dtype=wp.transform),
    box_body: wp.array(dtype=int),
    box_pose: wp.array(dtype=wp.transform),
    box_half: wp.array(dtype=wp.vec3),
    points: wp.array(dtype=wp.vec3),
):
    """Write the eight corners of every box."""
    i = wp.tid()
    pose = wp.transform_multiply(body_q[box_body[i]], box_pose[i])
    half = box_half[i]
    for k in range(8):
        corner = wp.vec3(
            half[0] * float(2 * (k / 4) - 1),
            half[1] * float(2 * ((k / 2) % 2) - 1),
            half[2] * float(2 * (k % 2) - 1),
        )
        points[first + 8 * i + k] = wp.transform_point(pose, corner)


@wp.kernel
def place_meshes(
    first: int,
    pose: wp.array(dtype=wp.mat44),
    vertex: wp.array(dtype=wp.vec3),
    vertex_mesh: wp.array(dtype=int),
    points: wp.array(dtype=wp.vec3),
):
    """Write the corners of every mesh."""
    i = wp.tid()
    points[first + i] = wp.transform_point(pose[vertex_mesh[i]], vertex[i])


@wp.kernel
def corner_normals(
    points: wp.array(dtype=wp.vec3),
    triangles: wp.array(dtype=wp.vec3i),
    sheet_triangles: int,
    star_start: wp.array(dtype=int),
    star: wp.array(dtype=int),
    mesh_triangle: int,
    mesh_pose: wp.array(dtype=wp.mat44),
    mesh_normals: wp.array2d(dtype=wp.vec3),
    triangle_mesh: wp.array(dtype=int),
    normals: wp.array2d(dtype=wp.vec3),
    changed: wp.array(dtype=int),
):
    """Write shading normals: smooth on sheets, flat on boxes and marks, a mesh's own.

    What has another normal looks different, even where it did not move: `changed` is 1 then.
    """
    f, k = wp.tid()
    tri = triangles[f]
    n = wp.vec3(0.0, 0.0, 0.0)
    if f >= mesh_triangle:
        local = mesh_normals[f - mesh_triangle, k]
        n = wp.transform_vector(mesh_pose[triangle_mesh[f - mesh_triangle]], local)
    elif f < sheet_triangles:
        for s in range(star_start[tri[k]], star_start[tri[k] + 1]):
            t = triangles[star[s]]
            n += wp.cross(points[t[1]] - points[t[0]], points[t[2]] - points[t[0]])
        n = wp.normalize(n)
    else:
        n = wp.normalize(wp.cross(points[tri[1]] - points[tri[0]], points[tri[2]] - points[tri[0]]))
    for axis in range(3):
        if normals[f, k][axis] != n[axis]:
            changed[f] = 1
    normals[f, k] = n


@wp.kernel
def find_moved(
    points: wp.array(dtype=wp.vec3), known: wp.array(dtype=wp.vec3), moved: wp.array(dtype=int)
):
    """Which points are elsewhere than when this was asked last."""
    i = wp.tid()
    moved[i] = 0
    for k in range(3):
        if points[i][k] != known[i][k]:
            moved[i] = 1
    known[i] = points[i]


@wp.kernel
def find_changed(
    scene: Scene,
    moved: wp.array(dtype=int),
    spheres: int,
    links: int,
    changed: wp.array(dtype=int),
):
    """Which primitives have a point that moved; triangles first, then spheres, then rods."""
    i = wp.tid()
    if i < spheres:
        tri = scene.triangles[i]
        changed[i] = moved[tri[0]] | moved[tri[1]] | moved[tri[2]]
    elif i < links:
        changed[i] = moved[scene.sphere_particle[i - spheres]]
    else:
        ends = scene.link_particle[i - links]
        changed[i] = moved[ends[0]] | moved[ends[1]]


class HostArray:
    """A device array with a numpy mirror; on the CPU the mirror is the array's own memory."""

    def __init__(self, shape: int | tuple[int, ...], dtype: Any, device: wp.Device) -> None:
        self.array = wp.zeros(shape, dtype=dtype, device=device)
        self._shared = device.is_cpu
        self.mirror: np.ndarray = self.array.numpy()

    def write(self, values: np.ndarray) -> None:
        """Copy `values` (anything that broadcasts) to the device."""
        self.mirror[...] = values
        if not self._shared:
            self.array.assign(self.mirror)

    def read(self) -> np.ndarray:
        """A fresh copy of what the device holds."""
        return self.mirror.copy() if self._shared else self.array.numpy()


class Geometry:
    """Arrays of one `Drawables` and a list of meshes, for states of a given size.

    Raises:
        InputError: the drawables point at particles or bodies that the state does not have.
    """

    def __init__(
        self,
        drawables: Drawables,
        particle_count: int,
        body_count: int,
        device: wp.Device,
        *,
        meshes: Sequence[Mesh] = (),
    ) -> None:
        d = drawables
        for name, used, count in (
            ("particle", (d.sphere_particle, d.triangle_particle, d.link_particle), particle_count),
            ("body", (d.box_body,), body_count),
        ):
            if max((int(u.max()) for u in used if u.size), default=-1) >= count:
                raise InputError(f"the state has {count} {name} entries, fewer than what is drawn")
        self.particle_count, self.body_count, self.device = particle_count, body_count, device
        boxes, marks = len(d.box_body), len(d.quad_segment)
        first_box = particle_count
        first_mark = first_box + 8 * boxes
        first_mesh = first_mark + 4 * marks
        starts = first_mesh + np.cumsum([0, *(len(m.vertices) for m in meshes)])
        marks_of = np.array([[0, 1, 2], [0, 2, 3]])
        triangles = np.concatenate(
            [
                d.triangle_particle,
                (first_box + 8 * np.arange(boxes)[:, None, None] + BOX_FACES).reshape(-1, 3),
                (first_mark + 4 * np.arange(marks)[:, None, None] + marks_of).reshape(-1, 3),
                *(start + m.faces for start, m in zip(starts, meshes, strict=False)),
            ]
        )
        mesh_of = np.repeat(np.arange(len(meshes)), [len(m.faces) for m in meshes])
        material = np.concatenate(
            [
                d.triangle_segment,
                np.repeat(d.box_segment, 12),
                np.repeat(d.quad_segment, 2),
                MESH_MATERIAL + mesh_of,
            ]
        )
        closed = np.zeros(len(triangles), int)
        first = len(d.triangle_particle)
        closed[first : first + 12 * boxes] = 1
        closed[len(triangles) - len(mesh_of) :] = np.array([m.closed for m in meshes], int)[mesh_of]
        palette = np.concatenate([d.palette, np.array([m.rgb for m in meshes]).reshape(-1, 3)])

        self._points = HostArray(int(starts[-1]), wp.vec3, device)
        points = self._points.mirror
        points[first_mark:first_mesh] = d.quad_corners.reshape(-1, 3)
        self._points.write(points)
        self._particles = points[:particle_count]
        self._particle_array = self._points.array[:particle_count] if particle_count else None
        self._body_q = HostArray(body_count, wp.transform, device)

        scene = Scene()
        scene.points = self._points.array
        scene.triangles = self._constant(triangles, wp.vec3i)
        scene.triangle_material = self._constant(material, wp.int32)
        scene.triangle_closed = self._constant(closed, wp.int32)
        scene.triangle_normals = wp.zeros((0, 3), dtype=wp.vec3, device=device)
        scene.sphere_particle = self._constant(d.sphere_particle, wp.int32)
        scene.sphere_radius = self._constant(d.sphere_radius, wp.float32)
        scene.sphere_material = self._constant(d.sphere_segment, wp.int32)
        scene.link_particle = self._constant(d.link_particle, wp.vec2i)
        scene.link_radius = self._constant(d.link_radius, wp.float32)
        scene.link_material = self._constant(d.link_segment, wp.int32)
        scene.palette = self._constant(palette, wp.vec3)
        self.scene = scene
        self.triangle_count = len(triangles)
        self.sphere_count = len(d.sphere_segment)
        self.link_count = len(d.link_segment)

        self._box_launch = None
        if boxes:
            self._box_launch = wp.launch(
                place_boxes,
                boxes,
                inputs=[
                    first_box,
                    self._body_q.array,
                    self._constant(d.box_body, wp.int32),
                    self._constant(d.box_pose, wp.transform),
                    self._constant(d.box_half, wp.vec3),
                    scene.points,
                ],
                device=device,
                record_cmd=True,
            )
        self._sheet_triangles = len(d.triangle_particle)
        self._first_mesh, self._mesh_triangle = first_mesh, len(triangles) - len(mesh_of)
        self._mesh_of = mesh_of
        self._meshes = tuple(meshes)
        self._smooth = False
        self.state: int | None = None
        self.previous_state: int | None = None

    def _constant(self, values: np.ndarray, dtype: Any) -> wp.array:
        return wp.array(values, dtype=dtype, device=self.device)

    def move(self, particle_q: np.ndarray, body_q: np.ndarray) -> None:
        """Bring particles (P, 3) [m] and bodies (B, 7) [m], quat_xyzw to their places."""
        particle_q, body_q = np.asarray(particle_q), np.asarray(body_q)
        if particle_q.shape != self._particles.shape or body_q.shape != (self.body_count, 7):
            raise InputError(
                f"expected particle_q ({self.particle_count}, 3) and body_q "
                f"({self.body_count}, 7), got {particle_q.shape} and {body_q.shape}"
            )
        if not (np.isfinite(particle_q).all() and np.isfinite(body_q).all()):
            raise InputError("a state that is not finite cannot be drawn")
        self._particles[...] = particle_q
        if not self.device.is_cpu and self._particle_array is not None:
            self._particle_array.assign(self._particles)
        if self._box_launch is not None:
            self._body_q.write(body_q)
            self._box_launch.launch()

    def prepare_scene(self) -> None:
        """Upload what only shaded scenes need: meshes and shading normals. Once per geometry."""
        if self._smooth:
            return
        self._smooth = True
        meshes = self._meshes
        corner = self.scene.triangles.numpy()[: self._sheet_triangles].reshape(-1)
        order = np.argsort(corner, kind="stable")
        counts = np.bincount(corner, minlength=self.particle_count)
        vertices = np.concatenate([np.zeros((0, 3)), *(m.vertices for m in meshes)])
        normals = [m.normals for m in meshes]
        self.scene.triangle_normals = wp.zeros(
            (self.triangle_count, 3), dtype=wp.vec3, device=self.device
        )
        self._pose = HostArray(len(meshes), wp.mat44, self.device)
        vertex_mesh = np.repeat(np.arange(len(meshes)), [len(m.vertices) for m in meshes])
        self._mesh_inputs = [
            self._first_mesh,
            self._pose.array,
            self._constant(vertices, wp.vec3),
            self._constant(vertex_mesh, wp.int32),
            self.scene.points,
        ]
        self._normal_inputs = [
            self.scene.points,
            self.scene.triangles,
            self._sheet_triangles,
            self._constant(np.concatenate([[0], np.cumsum(counts)]), wp.int32),
            self._constant(order // 3, wp.int32),
            self._mesh_triangle,
            self._pose.array,
            wp.array(
                np.concatenate([np.zeros((0, 3, 3)), *normals]), dtype=wp.vec3, device=self.device
            ),
            self._constant(self._mesh_of, wp.int32),
            self.scene.triangle_normals,
        ]
        points = len(self.scene.points)
        links = self.triangle_count + self.sphere_count
        self.changed = wp.zeros(links + self.link_count, dtype=wp.int32, device=self.device)
        self._moved = wp.zeros(points, dtype=wp.int32, device=self.device)
        self._known = wp.zeros(points, dtype=wp.vec3, device=self.device)

    def move_scene(self, mesh_poses: np.ndarray) -> None:
        """Bring the meshes to poses (M, 4, 4) and compute shading normals; call `move` first.

        Then `changed` (primitives,) is 1 for triangles, spheres and rods that look different in
        `state`, a number that no other state of any geometry has, than in `previous_state`; None is
        no state.
        """
        self.prepare_scene()
        poses = np.asarray(mesh_poses, dtype=float).reshape(-1, 4, 4)
        if len(poses) != len(self._meshes) or not np.isfinite(poses).all():
            raise InputError(f"expected {len(self._meshes)} finite mesh poses, got {len(poses)}")
        before, self.state = self.state, None  # until all is in its place
        device, scene = self.device, self.scene
        if len(poses):
            self._pose.write(poses)
            wp.launch(
                place_meshes, len(self._mesh_inputs[2]), inputs=self._mesh_inputs, device=device
            )
        spheres = self.triangle_count
        for kernel, dim, inputs in (
            (find_moved, len(scene.points), [scene.points, self._known, self._moved]),
            (
                find_changed,
                len(self.changed),
                [scene, self._moved, spheres, spheres + self.sphere_count, self.changed],
            ),
            (corner_normals, (self.triangle_count, 3), [*self._normal_inputs, self.changed]),
        ):
            wp.launch(kernel, dim, inputs=inputs, device=device)
        self.previous_state, self.state = before, next(_STATES)
