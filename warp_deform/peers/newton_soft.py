"""Fabrics and the bag's shell in Newton's VBD solver on the CPU, with its self-contact.

The settings are the cheapest found at which a folded sheet lies stretched by 1 to 2 %; beside the
vertex by which it is carried it stretches more. The solver's penetration-free self-contact (Divide
and Truncate) keeps layers apart whatever the settings.
Every frame is recorded once as a CPU graph and replayed.
"""

from __future__ import annotations

from dataclasses import dataclass

import newton
import numpy as np
import warp as wp

from ..errors import InputError
from ..objects.cloth import ClothConfig
from .newton_frame import record_frame
from .soft_scene import SoftScene
from .soft_timing import measure_soft
from .timing import FRAME_RATE, PeerTiming

__all__ = ["NewtonSoftWorld"]  # the rest is imported from `warp_deform.peers`

_SHEET, _BEAD, _CUBE = ClothConfig(), 0.01, 0.02  # masses of ours; those of bead and cube [kg]
_CUBE_HALF = 0.018  # [m]
_THICKNESS, _SHARE = 0.006, 0.6  # our layers touch at 6 mm, or at this share of a cell where less


@dataclass(frozen=True, kw_only=True)
class NewtonSoftSettings:
    """How VBD runs a fabric or a bag."""

    substeps: int = 6
    """Solver steps per frame; even, so that a recorded frame ends in the buffer it began in."""
    iterations: int = 6
    stiffness: float = 1e4
    """Lame parameters of the membrane, both [N/m]."""
    damping: float = 1e-4
    """Of the membrane, as a share of its stiffness [s]."""
    bend_stiffness: float = 1e-5
    """Of the angle between triangles [N m/rad]."""
    contact_stiffness: float = 1e4
    """Penalty stiffness of contacts [N/m]."""
    contact_damping: float = 0.0
    """Their damping [N s/m]."""
    friction: float = 0.5

    def __post_init__(self) -> None:
        if self.substeps < 2 or self.substeps % 2:
            raise InputError(f"NewtonSoftSettings.substeps must be even, got {self.substeps}")
        if self.iterations < 1:
            raise InputError(
                f"NewtonSoftSettings.iterations must be positive, got {self.iterations}"
            )


_SETTINGS = {
    "cloth10": NewtonSoftSettings(),
    "cloth25": NewtonSoftSettings(substeps=10),
    "cloth50": NewtonSoftSettings(substeps=20),
    "bag": NewtonSoftSettings(),
    "bag-cube": NewtonSoftSettings(),
}
_NOTE = (
    "self-contact of faces and edges that never pierces; a finite-element membrane without strain "
    "limits; one friction for table and layers, and no sleep: folds creep"
)
_BAG_NOTE = "; a bag's beads are masses at its vertices, without the chain"


def time_newton_soft(
    scene: str,
    *,
    seconds: float | None = None,
    repeats: int = 3,
    settings: NewtonSoftSettings | None = None,
) -> PeerTiming:
    """CPU cost of `scene`, one of `SOFT_SCENES`, in `newton.solvers.SolverVBD`.

    Raises:
        InputError: an argument is unknown or out of range.
    """
    chosen = settings or _SETTINGS.get(scene, NewtonSoftSettings())
    return measure_soft(
        lambda start: NewtonSoftWorld(start, chosen),
        engine="newton-vbd",
        scene=scene,
        seconds=seconds,
        repeats=repeats,
        hz=FRAME_RATE * chosen.substeps,
        iterations=chosen.iterations,
        note=_NOTE + _BAG_NOTE * scene.startswith("bag"),
    )


@wp.kernel
def _carry(position: wp.array(dtype=wp.vec3), step: wp.array(dtype=wp.vec3)):
    """Move vertex 0 by one substep's way."""
    position[0] = position[0] + step[0]


class NewtonSoftWorld:
    """One fabric or bag in VBD, its frame recorded as a CPU graph."""

    def __init__(self, scene: SoftScene, settings: NewtonSoftSettings | None = None) -> None:
        self._settings = settings = settings or _SETTINGS.get(scene.name, NewtonSoftSettings())
        builder = newton.ModelBuilder(gravity=(0.0, 0.0, -9.8))
        builder.default_shape_cfg.mu = settings.friction
        builder.default_shape_cfg.ke = settings.contact_stiffness
        builder.default_shape_cfg.kd = settings.contact_damping
        builder.add_ground_plane()
        _add_mesh(builder, scene, settings)
        if scene.cube is not None:
            cube = builder.add_body(xform=wp.transform(wp.vec3(*scene.cube), wp.quat_identity()))
            config = builder.default_shape_cfg.copy()
            config.density = _CUBE / (2 * _CUBE_HALF) ** 3
            builder.add_shape_box(cube, hx=_CUBE_HALF, hy=_CUBE_HALF, hz=_CUBE_HALF, cfg=config)
        builder.color(include_bending=True)
        self._model = model = builder.finalize(device="cpu")
        model.soft_contact_ke = settings.contact_stiffness
        model.soft_contact_kd = settings.contact_damping
        model.soft_contact_mu = settings.friction
        margin = min(_THICKNESS, _SHARE * float(np.median(scene.lengths)))
        self._pipeline = newton.CollisionPipeline(model)
        self._contacts = self._pipeline.contacts()
        self._solver = newton.solvers.SolverVBD(
            model,
            iterations=settings.iterations,
            particle_enable_self_contact=True,
            particle_self_contact_margin=margin,
            particle_self_contact_gap=margin / 2,
            # with the default of 2 rings the triangles beside a crease pierce each other
            particle_topological_contact_filter_threshold=1,
            # the triangles around a bag's pole are narrower than the margin
            particle_rest_shape_contact_exclusion_radius=1.2 * margin,
            # pairs beyond the buffers are dropped without a word
            particle_vertex_contact_buffer_size=64,
            particle_edge_contact_buffer_size=128,
        )
        self._control = model.control()
        self._state, self._next = model.state(), model.state()
        if model.body_count:
            newton.eval_fk(model, model.joint_q, model.joint_qd, self._state)
        self._step = wp.zeros(1, dtype=wp.vec3, device="cpu")
        self._graph = record_frame(self._simulate, self._solver, self._state)

    def _simulate(self) -> None:
        dt = 1 / (FRAME_RATE * self._settings.substeps)
        for _ in range(self._settings.substeps):
            self._state.clear_forces()
            wp.launch(_carry, 1, [self._state.particle_q, self._step], device="cpu")
            self._pipeline.collide(self._state, self._contacts)
            self._solver.step(self._state, self._next, self._control, self._contacts, dt)
            self._state, self._next = self._next, self._state

    def hold(self) -> None:
        """Make vertex 0 kinematic."""
        self._model.particle_flags.numpy()[0] &= ~int(newton.ParticleFlags.ACTIVE)

    def release(self) -> None:
        """Give vertex 0 back to the solver, at rest."""
        self._model.particle_flags.numpy()[0] |= int(newton.ParticleFlags.ACTIVE)
        self._state.particle_qd.numpy()[0] = 0.0

    def frame(self, target: np.ndarray | None = None) -> None:
        """Replay the recorded frame."""
        step = np.zeros(3)
        if target is not None:
            step = (target - self._state.particle_q.numpy()[0]) / self._settings.substeps
        self._step.numpy()[0] = step
        wp.capture_launch(self._graph)

    def vertices(self) -> np.ndarray:
        """Positions of the mesh (V, 3) [m]."""
        return self._state.particle_q.numpy().astype(float)

    def cube(self) -> np.ndarray:
        """Centre of the cube (3,) [m]."""
        return self._state.body_q.numpy()[0, :3].astype(float)

    def close(self) -> None:
        """Nothing to give back: arrays and graph end with this object."""


def _add_mesh(builder: newton.ModelBuilder, scene: SoftScene, settings: NewtonSoftSettings) -> None:
    corners = scene.vertices[scene.triangles]
    sides = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(sides, axis=1).sum() / 2
    mass = scene.mass if len(scene.ring) else _SHEET.mass
    builder.add_cloth_mesh(
        pos=wp.vec3(),
        rot=wp.quat_identity(),
        scale=1.0,
        vel=wp.vec3(),
        vertices=[wp.vec3(*vertex) for vertex in scene.vertices],
        indices=[int(corner) for corner in scene.triangles.ravel()],
        density=mass / area,
        tri_ke=settings.stiffness,
        tri_ka=settings.stiffness,
        tri_kd=settings.damping,
        edge_ke=settings.bend_stiffness,
        edge_kd=settings.bend_stiffness / 10,
        particle_radius=_SHEET.radius,
    )
    for vertex in scene.ring:
        builder.particle_mass[vertex] += _BEAD
