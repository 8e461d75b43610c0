"""The scenes in Newton's own solvers on the CPU, each at the cheapest settings that do the job.

"Do the job" means that the median over starts of the largest stretch is 1 to 3 %. Every
frame is recorded once as a CPU graph and replayed, which is several times cheaper than launching
its kernels one by one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import newton
import numpy as np
import warp as wp

from ..errors import InputError
from ..objects.box import add_box
from .newton_frame import record_frame
from .scene import PeerScene
from .timing import FRAME_RATE, PeerTiming, measure

__all__ = ["NewtonWorld"]  # the rest is imported from `warp_deform.peers`

_FRICTION = 0.5


@dataclass(frozen=True, kw_only=True)
class NewtonSettings:
    """How a stock Newton solver runs a scene."""

    solver: Literal["vbd", "xpbd"]
    beads: Literal["particles", "bodies"]
    """Point masses joined by springs, or rigid spheres joined by ball joints."""
    substeps: int
    """Solver steps per frame; even, so that a recorded frame ends in the buffer it began in."""
    iterations: int
    """Solver iterations per step. Even for XPBD: with an odd number links stretch to double."""
    link_stiffness: float = 2e5
    """Stiffness of the springs between particles [N/m]; VBD diverges at 1e6. Unused for bodies."""
    link_damping: float = 3.0
    """Damping of those springs [N s/m]."""
    contact_stiffness: float = 1e5
    """Stiffness of a penalty contact [N/m]; XPBD has none."""
    contact_damping: float | None = None
    """Damping of a penalty contact [N s/m]: without enough of it what falls bounces, the more the
    finer the steps. None: 10 of particles, none of bodies."""
    joint_relaxation: float = 1.0
    """Share of a joint's error that one XPBD iteration corrects."""
    note: str = ""

    def __post_init__(self) -> None:
        if self.substeps < 2 or self.substeps % 2:
            raise InputError(f"NewtonSettings.substeps must be even, got {self.substeps}")
        if self.iterations < 1 or (self.solver == "xpbd" and self.iterations % 2):
            raise InputError(
                f"NewtonSettings.iterations must be positive (even for XPBD), got {self.iterations}"
            )


NEWTON_SOLVERS = ("vbd", "vbd-bodies", "xpbd")
"""Names that `time_newton` and `newton_settings` know."""

_CONTACT_NOTE = "rigid spheres and ball joints, contact between beads, no bending limit"
_SETTINGS = {
    "vbd": NewtonSettings(
        solver="vbd",
        beads="particles",
        substeps=20,
        iterations=2,
        contact_stiffness=1e4,
        note="particles and springs: beads pass through each other, no bending limit",
    ),
    "vbd-bodies": NewtonSettings(
        solver="vbd", beads="bodies", substeps=10, iterations=5, note=_CONTACT_NOTE
    ),
    "xpbd": NewtonSettings(
        solver="xpbd", beads="bodies", substeps=12, iterations=2, note=_CONTACT_NOTE
    ),
}


def newton_settings(solver: str, scene: str) -> NewtonSettings:
    """The cheapest settings found for `scene` in "vbd", "vbd-bodies" or "xpbd".

    Raises:
        InputError: there is no such solver.
    """
    if solver not in _SETTINGS:
        raise InputError(f"no Newton peer {solver!r}; choose from {', '.join(NEWTON_SOLVERS)}")
    settings = _SETTINGS[solver]
    if scene == "ring" and solver == "xpbd":
        # the closed chain falls stiffly on its edge: the cable's settings stretch it by 5 %
        return replace(settings, substeps=16, iterations=4)
    if scene in ("block", "tower"):
        note = "one rigid body of two boxes" if scene == "block" else "rigid boxes"
        return replace(settings, beads="bodies", substeps=4, iterations=4, note=note)
    return settings


def time_newton(
    scene: str,
    solver: str = "vbd",
    *,
    seconds: float = 1.0,
    repeats: int = 5,
    settings: NewtonSettings | None = None,
) -> PeerTiming:
    """CPU cost of `scene`, one of `PEER_SCENES`, in a stock Newton solver.

    Args:
        scene: What to simulate; the block is a rigid body in every solver.
        solver: "vbd", "vbd-bodies" or "xpbd".
        seconds: Simulated time of one measurement [s].
        repeats: Number of starts.
        settings: Used instead of `newton_settings(solver, scene)`.

    Raises:
        InputError: an argument is unknown or out of range.
    """
    chosen = settings or newton_settings(solver, scene)
    return measure(
        lambda start: NewtonWorld(start, chosen),
        engine=f"newton-{solver}",
        scene=scene,
        seconds=seconds,
        repeats=repeats,
        hz=FRAME_RATE * chosen.substeps,
        iterations=chosen.iterations,
        note=chosen.note,
    )


class NewtonWorld:
    """One scene in a stock Newton solver, its frame recorded as a CPU graph."""

    def __init__(self, scene: PeerScene, settings: NewtonSettings) -> None:
        self._settings = settings
        builder = newton.ModelBuilder(gravity=(0.0, 0.0, -9.8))
        builder.default_shape_cfg.mu = _FRICTION
        builder.default_shape_cfg.ke = settings.contact_stiffness
        builder.default_shape_cfg.kd = settings.contact_damping or 0.0
        builder.add_ground_plane()
        if scene.cable is None:
            assert scene.block is not None
            for (x, y, z), yaw in zip(scene.positions.tolist(), scene.yaws.tolist(), strict=True):
                for shape in add_box(builder, scene.block, (x, y, z), yaw=yaw).shapes:
                    builder.shape_material_ke[shape] = settings.contact_stiffness
                    builder.shape_material_kd[shape] = settings.contact_damping or 0.0
        elif settings.beads == "particles":
            _add_particles(builder, scene, settings)
        else:
            _add_spheres(builder, scene)
        builder.color()
        self._model = model = builder.finalize(device="cpu")
        model.soft_contact_ke = settings.contact_stiffness
        model.soft_contact_mu = _FRICTION
        if settings.contact_damping is not None:
            model.soft_contact_kd = settings.contact_damping
        self._pipeline = newton.CollisionPipeline(model)
        self._contacts = self._pipeline.contacts()
        self._solver = _make_solver(model, settings)
        self._control = model.control()
        self._state, self._next = model.state(), model.state()
        newton.eval_fk(model, model.joint_q, model.joint_qd, self._state)
        self._graph = record_frame(self._simulate, self._solver, self._state)

    def _simulate(self) -> None:
        dt = 1 / (FRAME_RATE * self._settings.substeps)
        for _ in range(self._settings.substeps):
            self._state.clear_forces()
            self._pipeline.collide(self._state, self._contacts)
            self._solver.step(self._state, self._next, self._control, self._contacts, dt)
            self._state, self._next = self._next, self._state

    def frame(self) -> None:
        """Replay the recorded frame."""
        wp.capture_launch(self._graph)

    def beads(self) -> np.ndarray:
        """Positions of particles or bodies, (bodies, 3) [m]."""
        if self._model.particle_count:
            return self._state.particle_q.numpy().astype(float)
        return self._state.body_q.numpy()[:, :3].astype(float)

    def close(self) -> None:
        """Nothing to give back: arrays and graph end with this object."""


def _make_solver(model: newton.Model, settings: NewtonSettings) -> newton.solvers.SolverBase:
    if settings.solver == "vbd":
        return newton.solvers.SolverVBD(model, iterations=settings.iterations)
    return newton.solvers.SolverXPBD(
        model,
        iterations=settings.iterations,
        joint_linear_relaxation=settings.joint_relaxation,
    )


def _add_particles(
    builder: newton.ModelBuilder, scene: PeerScene, settings: NewtonSettings
) -> None:
    cable = scene.cable
    assert cable is not None
    for bead in scene.beads:
        builder.add_particle(wp.vec3(*bead), wp.vec3(), cable.mass, radius=cable.radius)
    for i, j in scene.links:
        builder.add_spring(int(i), int(j), settings.link_stiffness, settings.link_damping, 0.0)
        builder.spring_rest_length[-1] = cable.spacing


def _add_spheres(builder: newton.ModelBuilder, scene: PeerScene) -> None:
    cable = scene.cable
    assert cable is not None
    config = builder.default_shape_cfg.copy()
    config.density = cable.mass / (4 / 3 * np.pi * cable.radius**3)
    identity = wp.quat_identity()
    bodies = []
    for bead in scene.beads:
        bodies.append(builder.add_link(xform=wp.transform(wp.vec3(*bead), identity)))
        builder.add_shape_sphere(bodies[-1], radius=cable.radius, cfg=config)
    root = wp.transform(wp.vec3(*scene.beads[0]), identity)
    joints = [builder.add_joint_free(child=bodies[0])]
    builder.joint_q[-7:] = [*root]
    for i, j in scene.links:
        step = wp.vec3(*(scene.beads[j] - scene.beads[i]))
        joint = builder.add_joint_ball(
            parent=bodies[i],
            child=bodies[j],
            parent_xform=wp.transform(step, identity),
            child_xform=wp.transform(wp.vec3(), identity),
        )
        # the link that closes a ring stays outside the tree
        if j > i:
            joints.append(joint)
    builder.add_articulation(joints)
