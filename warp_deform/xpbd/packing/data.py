"""The solver's working arrays: worlds of a model packed into groups of SIMD lanes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import newton
import numpy as np
import warp as wp

from ...objects.push import MOST_PUSHES
from ...support.quaternion import quat_rotate
from ..bodies.box_box import POINTS
from ..config import WORLD_PARAMETERS
from ..springs.tether import NO_TETHER
from .groups import NUMPY, PackedWorlds
from .mirrored import Mirrored
from .sheet_data import add_sheets
from .topology import pieces, tethers

__all__ = ["KERNEL_ARGUMENTS", "WATCHED", "SolverData"]

KERNEL_ARGUMENTS = ("topology", "springs", "pairs", "shapes", "group", "particles", "near",
                    "bodies", "contacts", "grips", "watch", "sheets", "cells", "lines",
                    "tape")  # fmt: skip
"""The kernel's structs, after the settings, in the order of its arguments."""

WATCHED = ("steps", "nonfinite", "stretch", "depth", "box_depth", "box_overlap", "clamped",
           "overflow")  # fmt: skip
"""What a launch notes of every world, in the order of the fields of `WatchValues`."""


def alias_lanes(structs: list[Any], scalar: Any) -> None:
    """Let `Cells` see the particles in lanes scalar by scalar; structs as `KERNEL_ARGUMENTS`."""
    particles, cells = (structs[KERNEL_ARGUMENTS.index(name)] for name in ("particles", "cells"))
    for field, array in (
        ("x", particles.x), ("xp", particles.xp), ("w", particles.w), ("xr_flat", cells.xr),
        ("slack_flat", cells.slack),
    ):  # fmt: skip
        count = array.capacity // np.dtype(NUMPY[scalar]).itemsize
        flat = wp.array(ptr=array.ptr, dtype=scalar, shape=(count,), device=array.device)
        setattr(cells, field, flat)


class SolverData(PackedWorlds):
    """Arrays of all worlds of a model in one precision and lane width.

    World w lives in group ``slot[w] // L``, lane ``slot[w] % L``. Every array is a `Mirrored` under
    ``arrays["struct.field"]``; `views` gives their NumPy views by the same names.
    """

    def __init__(
        self,
        model: newton.Model,
        *,
        scalar: Any = wp.float32,
        lanes: int = 8,
        pairs_per_particle: int = 48,
    ) -> None:
        super().__init__(model, scalar=scalar, lanes=lanes)
        self.edits = 0
        """How often what the worlds are made of was changed, for those who keep a copy of it."""
        self._fill_topologies(pairs_per_particle)
        add_sheets(self, pairs_per_particle)
        self._fill_particles()
        self._fill_bodies()
        self._fill_grips()
        self.reset()

    # -- construction

    def _fill_topologies(self, pairs_per_particle: int) -> None:
        t, number = self.types, self.number
        tops = self.topologies

        fabrics = [pieces(k) for k in tops]
        neighbours = [pairs for found in fabrics for pairs in found]
        members = [np.unique(pairs) for pairs in neighbours]

        def starts(field: str) -> np.ndarray:
            return np.concatenate([[0], np.cumsum([len(getattr(k, field)) for k in tops])])

        def joined(field: str) -> np.ndarray:
            return np.concatenate([np.asarray(getattr(k, field)) for k in tops])

        for name, values in (
            ("topology.particle_count", [k.particle_count for k in tops]),
            ("topology.particle_start", starts("particle_radius")),
            ("topology.body_count", [k.body_count for k in tops]),
            ("topology.spring_start", starts("spring_ij")),
            ("topology.passes", [k.passes for k in tops]),
            ("topology.pair_start", starts("pair_ij")),
            ("topology.shape_count", [len(k.shape_body) for k in tops]),
            ("springs.mode", joined("spring_mode")),
            ("springs.watched", joined("spring_watched")),
            ("springs.middle", joined("spring_middle")),
            ("springs.run", joined("spring_run")),
            ("topology.piece_start", np.cumsum([0, *map(len, fabrics)])),
            ("springs.neighbour_first", np.cumsum([0, *map(len, neighbours)])),
            ("springs.member_first", np.cumsum([0, *map(len, members)])),
            ("springs.members", np.concatenate([np.zeros(0, int), *members])),
        ):
            self.add_constant(name, np.asarray(values), wp.int32, np.int32)
        joint = np.concatenate([np.zeros((0, 2), int), *neighbours])
        self.add_constant("springs.neighbours", joint, wp.vec2i, np.int32)
        self.add_constant("topology.radius", joined("particle_radius"), t.S, number)
        for name in ("springs.ij", "pairs.ij"):
            self.add_constant(name, joined(_field(name)), wp.vec2i, np.int32)
        for name in (
            "springs.length",
            "springs.compliance",
            "springs.limit",
            "springs.floor",
            "pairs.distance",
        ):
            self.add_constant(name, joined(_field(name)), t.S, number)
        groups, L = self.group_count, self.lanes
        # every world has its own boxes: their sizes may differ
        for name, dtype, kind in (
            ("body", wp.int32, np.int32), ("friction", t.S, number), ("center", t.R3, number),
            ("half", t.R3, number), ("rotation", t.Q, number),
        ):  # fmt: skip
            of_worlds = [
                getattr(tops[k], f"shape_{name}") for k in self.group_topology for _ in range(L)
            ]
            self.add_constant(f"shapes.{name}", np.concatenate(of_worlds), dtype, kind)
        shape_start = np.cumsum([0, *(L * len(tops[k].shape_body) for k in self.group_topology)])
        capacity = [
            # a group's list holds the pairs of all its lanes, so each lane has its own share
            min(len(tops[k].pair_ij), L * pairs_per_particle * max(tops[k].particle_count, 1))
            for k in self.group_topology
        ]
        near_start = np.concatenate([[0], np.cumsum(capacity)])
        contact_room = [_contact_room(tops[k].shape_body) for k in self.group_topology]
        contact_start = np.concatenate([[0], np.cumsum(contact_room)])
        for name, values in (
            ("topology", self.group_topology),
            ("particle_start", self.group_particle[:-1]),
            ("body_start", self.group_body[:-1]),
            ("near_start", near_start[:-1]),
            ("near_capacity", capacity),
            ("contact_start", contact_start[:-1]),
            ("shape_start", shape_start[:-1]),
        ):
            self.add_constant(f"group.{name}", np.asarray(values), wp.int32, np.int32)
        for name in ("active", *WORLD_PARAMETERS,
                     "calm_steps", "calm_after", "least_steps", "most_steps"):  # fmt: skip
            self.add_array(f"group.{name}", groups, t.V, (L,), number)
        self.add_array("group.gravity", groups, t.V3, (3, L), number)
        total = int(near_start[-1])
        self.add_array("near.pair", total, wp.int32, (), np.int32)
        self.add_array("near.mask", total, t.V, (L,), number)
        total = int(contact_start[-1])
        for name in ("a", "b", "order"):
            self.add_array(f"contacts.{name}", total, wp.int32, (), np.int32)
        for name in ("ra", "rb", "normal", "u", "v", "weights", "upper", "steps", "impulse"):
            self.add_array(f"contacts.{name}", total, t.R3, (3,), number)
        self.add_array("contacts.mu", total, t.S, (), number)

    def _fill_particles(self) -> None:
        count, L = int(self.group_particle[-1]), self.lanes
        for name in ("x", "v", "xp", "xr", "dv", "anchor"):
            self.add_array(f"particles.{name}", count, self.types.V3, (3, L), self.number)
        for name in ("w", "w0", "tether", "still"):
            self.add_array(f"particles.{name}", count, self.types.V, (L,), self.number)
        room = count if self.has_lines else 0
        for name in ("along", "bend"):
            self.add_array(f"lines.{name}", room, self.types.V3, (3, L), self.number)
        for name in ("length", "target", "elastic", "inverse", "ratio", "ratio2", "multiplier",
                     "turned"):  # fmt: skip
            self.add_array(f"lines.{name}", room, self.types.V, (L,), self.number)
        if self.has_particles:
            inverse = self.model.particle_inv_mass.numpy()
            for w in range(self.world_count):
                self.lane("particles.w0", w)[:] = inverse[self.particle_ids[w]]

    def _fill_bodies(self) -> None:
        t, number, count = self.types, self.number, int(self.group_body[-1])
        for name, dtype, shape in (
            ("x", t.R3, (3,)), ("q", t.Q, (4,)), ("v", t.R3, (3,)), ("omega", t.R3, (3,)),
            ("xp", t.R3, (3,)), ("qp", t.Q, (4,)), ("w", t.S, ()), ("w0", t.S, ()),
            ("inertia", t.M33, (3, 3)), ("inverse_inertia", t.M33, (3, 3)),
            ("dx", t.R3, (3,)), ("dr", t.R3, (3,)), ("spread", t.M33, (3, 3)),
        ):  # fmt: skip
            self.add_array(f"bodies.{name}", count, dtype, shape, number)
        for name in ("touching", "support"):
            self.add_array(f"bodies.{name}", count, wp.int32, (), np.int32)
        self.views["bodies.q"][:, 3] = 1.0
        if self.has_bodies:
            for w in range(self.world_count):
                ids, rows = self.body_ids[w], self.body_rows(w)
                self.views["bodies.w0"][rows] = self.model.body_inv_mass.numpy()[ids]
                self.views["bodies.inertia"][rows] = self.model.body_inertia.numpy()[ids]
                self.views["bodies.inverse_inertia"][rows] = self.model.body_inv_inertia.numpy()[
                    ids
                ]

    def _fill_grips(self) -> None:
        t, number, slots = self.types, self.number, self.group_count * self.lanes
        for name in (
            "particle",
            "body",
            "tick",
            "knot",
            "knot_end",
        ):
            self.add_array(f"grips.{name}", slots, wp.int32, (), np.int32)
        for name in ("push", "push_steps"):
            self.add_array(f"grips.{name}", slots * MOST_PUSHES, wp.int32, (), np.int32)
        self.add_array("grips.push_acceleration", slots * MOST_PUSHES, t.R3, (3,), number)
        for name, dtype, shape in (
            ("offset", t.R3, (3,)), ("turn", t.Q, (4,)), ("lower_start", t.S, ()),
            ("lower_end", t.S, ()), ("shift", t.R3, (3,)),
        ):  # fmt: skip
            self.add_array(f"grips.{name}", slots, dtype, shape, number)
        self.reserve_knots(slots * 16)
        for name in WATCHED:
            self.add_array(f"watch.{name}", self.group_count, t.V, (self.lanes,), number)
        self.reserve_frames(0)

    def reserve_knots(self, count: int) -> None:
        """Make room for `count` knots of all paths together."""
        t, number = self.types, self.number
        self.knot_room = count
        for name, dtype, shape in (
            ("time", t.S, ()), ("position", t.R3, (3,)), ("rotation", t.Q, (4,))
        ):  # fmt: skip
            self.add_array(f"grips.{name}", count, dtype, shape, number)

    def reserve_frames(self, frames: int) -> None:
        """Make room for `frames` recorded frames."""
        t, number = self.types, self.number
        self.frame_room = frames
        particles, bodies = int(self.group_particle[-1]), int(self.group_body[-1])
        self.add_array("watch.frame_x", frames * particles, t.V3, (3, self.lanes), number)
        self.add_array("watch.frame_body_x", frames * bodies, t.R3, (3,), number)
        self.add_array("watch.frame_body_q", frames * bodies, t.Q, (4,), number)

    # -- access

    def to_device(self) -> None:
        """Make the device see what was written to the views."""
        if not self.device.is_cpu:
            for mirrored in self.arrays.values():
                mirrored.to_device()

    def to_host(self) -> None:
        """Make the views see what a kernel wrote."""
        if not self.device.is_cpu:
            for mirrored in self.arrays.values():
                mirrored.to_host()

    def struct(self, name: str, own: Mapping[str, Mirrored] | None = None) -> Any:
        """One of the kernel's structs (see `KERNEL_ARGUMENTS`), filled with the arrays.

        Args:
            own: arrays to take in place of those of the same names
        """
        value = getattr(self.types, name.capitalize())()
        for key, mirrored in {**self.arrays, **(own or {})}.items():
            owner, field = key.split(".")
            if owner == name:
                setattr(value, field, mirrored.array)
        return value

    def structs(self, own: Mapping[str, Mirrored] | None = None) -> list[Any]:
        """All structs of the kernel, in the order of `KERNEL_ARGUMENTS`; `own` as for `struct`."""
        out = [self.struct(name, own) for name in KERNEL_ARGUMENTS]
        alias_lanes(out, self.scalar)
        return out

    def lane(self, name: str, world: int) -> np.ndarray:
        """Writable view of one world's particles in an array of V3 -> (P, 3) or V -> (P,)."""
        return self.lane_of(self.arrays[name], world)

    def lane_of(self, array: Mirrored, world: int) -> np.ndarray:
        """A world's rows (P, ...) of an array in lanes that is not the solver's own, a view."""
        group, lane = divmod(int(self.slot[world]), self.lanes)
        rows = slice(self.group_particle[group], self.group_particle[group + 1])
        return array.view[rows][..., lane]

    def body_rows(self, world: int) -> slice:
        """Rows of one world's bodies in the arrays of bodies."""
        group, lane = divmod(int(self.slot[world]), self.lanes)
        count = self.topologies[self.group_topology[group]].body_count
        start = int(self.group_body[group]) + lane * count
        return slice(start, start + count)

    def set_box(
        self, world: int, body: int, size: np.ndarray, mass: float, inertia: np.ndarray
    ) -> None:
        """Give a body that is one box around its frame another size (3,) [m], mass [kg], inertia.

        inertia (3, 3) [kg m^2]
        """
        group, lane = divmod(int(self.slot[world]), self.lanes)
        owner = self.topologies[self.group_topology[group]].shape_body
        shapes = np.flatnonzero(owner == body)
        if len(shapes) != 1:
            raise ValueError(
                f"body {body} has {len(shapes)} boxes; only a single one can be changed"
            )
        self.edits += 1
        views, row = self.views, self.body_rows(world).start + body
        start = int(views["group.shape_start"][group]) + lane * len(owner)
        views["shapes.half"][start + shapes[0]] = np.asarray(size) / 2
        views["bodies.w0"][row] = views["bodies.w"][row] = 1.0 / mass
        views["bodies.inertia"][row] = inertia
        views["bodies.inverse_inertia"][row] = np.linalg.inv(inertia)

    def per_world(self, name: str, world: int) -> np.ndarray:
        """Writable element of one world in a per-group array of V -> () or V3 -> (3,)."""
        group, lane = divmod(int(self.slot[world]), self.lanes)
        return self.arrays[name].view[group][..., lane : lane + 1]

    def reset(self) -> None:
        """Everything as the model starts, nothing gripped."""
        views = self.views
        if self.has_particles:
            positions, velocities = self.model.particle_q.numpy(), self.model.particle_qd.numpy()
            for w in range(self.world_count):
                self.lane("particles.x", w)[:] = positions[self.particle_ids[w]]
                self.lane("particles.v", w)[:] = velocities[self.particle_ids[w]]
                self.wake(w)
        views["particles.w"][:] = views["particles.w0"]
        if self.has_bodies:
            poses, twists = self.model.body_q.numpy(), self.model.body_qd.numpy()
            for w in range(self.world_count):
                self.set_bodies(w, poses[self.body_ids[w]], twists[self.body_ids[w]])
        views["bodies.w"][:] = views["bodies.w0"]
        self.clear_grips()

    def wake(self, world: int) -> None:
        """Nothing of a world's fabrics sleeps, or has lain still yet."""
        self.lane("particles.still", world)[:] = 0.0
        self.lane("particles.anchor", world)[:] = self.lane("particles.x", world)

    def clear_watch(self) -> None:
        """Nothing is noted yet."""
        for name in WATCHED:
            self.views[f"watch.{name}"][...] = 0

    def clear_grips(self) -> None:
        """Nothing is gripped or pushed in any world."""
        for name in ("particle", "body", "push"):
            self.arrays[f"grips.{name}"].view[:] = -1
        self.arrays["particles.tether"].view[:] = NO_TETHER

    def tether(self, world: int, held: int) -> None:
        """Tie the particles of a fabric to the one that will be held."""
        topology = self.topologies[self.world_topology[world]]
        self.lane("particles.tether", world)[:] = tethers(topology, held)

    def set_bodies(self, world: int, body_q: np.ndarray, body_qd: np.ndarray | None = None) -> None:
        """Set poses (B, 7) and twists (B, 6: linear at the centre of mass, angular) of a world."""
        rows = self.body_rows(world)
        if rows.start == rows.stop:  # as of most cables and fabrics, which are looked at often
            return np.zeros((0, 7), self.number), np.zeros((0, 6), self.number)
        com = self.topologies[self.world_topology[world]].body_com
        views = self.views
        quat = np.asarray(body_q)[:, 3:]
        # a unit quaternion stays as it is, so that steps through a Newton state lose no bits
        norm = np.linalg.norm(quat, axis=1, keepdims=True)
        quat = np.where(np.abs(norm - 1.0) > 1e-6, quat / norm, quat)
        views["bodies.x"][rows] = np.asarray(body_q)[:, :3] + quat_rotate(quat, com)
        views["bodies.q"][rows] = quat
        views["bodies.v"][rows] = 0.0 if body_qd is None else np.asarray(body_qd)[:, :3]
        views["bodies.omega"][rows] = 0.0 if body_qd is None else np.asarray(body_qd)[:, 3:]

    def body_poses(self, world: int) -> tuple[np.ndarray, np.ndarray]:
        """Poses (B, 7) of the bodies' frames and twists (B, 6) of one world."""
        rows = self.body_rows(world)
        if rows.start == rows.stop:  # as of most cables and fabrics, which are looked at often
            return np.zeros((0, 7), self.number), np.zeros((0, 6), self.number)
        com = self.topologies[self.world_topology[world]].body_com
        views = self.views
        pose = self.frame_poses(views["bodies.x"][rows], views["bodies.q"][rows], com)
        return pose, np.column_stack([views["bodies.v"][rows], views["bodies.omega"][rows]])

    @staticmethod
    def frame_poses(x: np.ndarray, quat: np.ndarray, com: np.ndarray) -> np.ndarray:
        """Poses (B, 7) of body frames from centres of mass x (B, 3), turns and offsets (B, 3)."""
        # a scene without bodies asks for none at every control step of every world
        return np.column_stack([x - quat_rotate(quat, com) if len(x) else x, quat])


def _contact_room(shape_body: np.ndarray) -> int:
    """Most contacts that bodies with these shapes can have."""
    a, b = np.triu_indices(len(shape_body), 1)
    pairs = int((shape_body[a] != shape_body[b]).sum())
    return POINTS * pairs + 8 * len(shape_body)


def _field(name: str) -> str:
    """Field of `WorldTopology` that fills an array: "springs.length" is "spring_length"."""
    return name.replace("s.", "_", 1)
