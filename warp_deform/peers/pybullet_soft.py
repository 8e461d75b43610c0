"""Fabrics and bags in PyBullet, at the settings of the original DeformableRavens environment.

Source: Seita et al., ICRA 2021, and its released code: a deformable world, 480 Hz, gravity
9.8 m/s^2, mass-spring soft bodies with bending springs (elastic stiffness 40, damping 0.1 along
the springs only, no Neo-Hookean), self-collision, face contact, friction 1; a bag's 32 beads are
cubes of 0.01 kg and half extent 5 mm, each anchored to its vertex of the opening, in a closed chain
of point-to-point constraints of at most 100 N.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .pybullet_peer import check_steps, import_pybullet
from .soft_scene import SoftScene
from .soft_timing import measure_soft
from .timing import FRAME_RATE, PeerTiming

__all__ = ["PyBulletSoftWorld"]  # the rest is imported from `warp_deform.peers`

HZ = 480
_BEAD_MASS, _BEAD_HALF = 0.01, 0.005  # [kg], [m]
_MAX_FORCE = 100.0  # [N]
_CUBE_MASS, _CUBE_HALF = 0.02, 0.018  # [kg], [m]
_TIP_MASS = 1.0  # [kg]
_GRAVITY = 9.8  # [m/s^2]
_NOTE = (
    "as the original: springs of stiffness 40, which stretch much, self-collision, friction 1; "
    "without the arm, which the original also steps: a weight of given velocity holds the vertex"
)


@dataclass(frozen=True, kw_only=True)
class PyBulletSoftSettings:
    """How PyBullet runs a fabric or a bag; the defaults are the original's."""

    hz: int = HZ
    """Steps per second; a multiple of the frame rate."""
    iterations: int = 50

    def __post_init__(self) -> None:
        check_steps("PyBulletSoftSettings", self.hz, self.iterations)


def time_pybullet_soft(scene: str, *, seconds: float | None = None, repeats: int = 3) -> PeerTiming:
    """CPU cost of `scene`, one of `SOFT_SCENES`, in PyBullet, one process, one thread.

    Raises:
        InputError: PyBullet is not installed, or an argument is unknown or out of range.
    """
    import_pybullet()
    return measure_soft(
        PyBulletSoftWorld,
        engine="pybullet",
        scene=scene,
        seconds=seconds,
        repeats=repeats,
        hz=HZ,
        iterations=PyBulletSoftSettings().iterations,
        note=_NOTE,
    )


class PyBulletSoftWorld:
    """One fabric or bag in a PyBullet client of its own."""

    def __init__(self, scene: SoftScene, settings: PyBulletSoftSettings | None = None) -> None:
        self._settings = settings = settings or PyBulletSoftSettings()
        self._bullet = bullet = import_pybullet()
        self._client = {"physicsClientId": bullet.connect(bullet.DIRECT)}
        bullet.setPhysicsEngineParameter(
            enableFileCaching=0, numSolverIterations=settings.iterations, **self._client
        )
        bullet.resetSimulation(bullet.RESET_USE_DEFORMABLE_WORLD, **self._client)
        bullet.setGravity(0, 0, -_GRAVITY, **self._client)
        bullet.setTimeStep(1 / settings.hz, **self._client)
        self._add_table()
        self._soft = self._add_mesh(scene)
        self._beads = self._add_beads(scene)
        self._cube = None
        if scene.cube is not None:
            self._cube = self._add_box(_CUBE_MASS, _CUBE_HALF, scene.cube)
        self._tip: int | None = None
        self._anchor: int | None = None

    def _add_table(self) -> None:
        """The original's slab, and its ground 1 mm below.

        The ground is a box too: a fabric hovers 10 cm above PyBullet's infinite plane.
        """
        bullet = self._bullet
        for half, position in (
            ((15.0, 15.0, 5.0), (0, 0, -5.001)),
            ((1.0, 1.5, 0.005), (0.5, 0, -0.005)),
        ):
            shape = bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=half, **self._client)
            body = bullet.createMultiBody(0, shape, basePosition=position, **self._client)
            bullet.changeDynamics(body, -1, lateralFriction=1.0, **self._client)

    def _add_mesh(self, scene: SoftScene) -> int:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "mesh.obj"
            lines = ["v {:.9g} {:.9g} {:.9g}".format(*vertex) for vertex in scene.vertices]
            lines += ["f {} {} {}".format(*corners) for corners in scene.triangles + 1]
            path.write_text("\n".join(lines) + "\n")
            return self._bullet.loadSoftBody(
                str(path),
                mass=scene.mass,
                collisionMargin=scene.margin,
                useMassSpring=1,
                useBendingSprings=1,
                useNeoHookean=0,
                springElasticStiffness=40,
                springDampingStiffness=0.1,
                springDampingAllDirections=0,
                useSelfCollision=1,
                frictionCoeff=1.0,
                useFaceContact=1,
                **self._client,
            )

    def _add_box(self, mass: float, half: float, position: np.ndarray) -> int:
        bullet = self._bullet
        shape = bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=[half] * 3, **self._client)
        return bullet.createMultiBody(mass, shape, basePosition=tuple(position), **self._client)

    def _add_beads(self, scene: SoftScene) -> list[int]:
        bullet = self._bullet
        centres = scene.vertices[scene.ring]
        beads = [self._add_box(_BEAD_MASS, _BEAD_HALF, centre) for centre in centres]
        for bead, vertex in zip(beads, scene.ring, strict=True):
            bullet.createSoftBodyAnchor(self._soft, int(vertex), bead, -1, **self._client)
        for k, bead in enumerate(beads):
            after = (k + 1) % len(beads)
            joint = bullet.createConstraint(
                bead,
                -1,
                beads[after],
                -1,
                bullet.JOINT_POINT2POINT,
                jointAxis=(0, 0, 0),
                parentFramePosition=tuple(centres[after] - centres[k]),
                childFramePosition=(0, 0, 0),
                **self._client,
            )
            bullet.changeConstraint(joint, maxForce=_MAX_FORCE, **self._client)
        return beads

    def hold(self) -> None:
        """Anchor vertex 0 to a weight that touches nothing."""
        bullet = self._bullet
        self._tip = self._add_box(_TIP_MASS, 0.001, self.vertices()[0])
        bullet.setCollisionFilterGroupMask(self._tip, -1, 0, 0, **self._client)
        self._anchor = bullet.createSoftBodyAnchor(self._soft, 0, self._tip, -1, **self._client)

    def release(self) -> None:
        """Drop the anchor; the weight is then idle and out of the way."""
        bullet = self._bullet
        bullet.removeConstraint(self._anchor, **self._client)
        bullet.resetBasePositionAndOrientation(self._tip, (0, 0, -20), (0, 0, 0, 1), **self._client)
        self._tip = self._anchor = None

    def frame(self, target: np.ndarray | None = None) -> None:
        """Advance by 1 / FRAME_RATE simulated seconds."""
        bullet, hz = self._bullet, self._settings.hz
        steps = hz // FRAME_RATE
        for k in range(steps):
            if target is not None and self._tip is not None:
                tip = bullet.getBasePositionAndOrientation(self._tip, **self._client)[0]
                velocity = (target - tip) * hz / (steps - k)
                velocity[2] += _GRAVITY / hz  # what the step takes away
                bullet.resetBaseVelocity(self._tip, tuple(velocity), (0, 0, 0), **self._client)
            bullet.stepSimulation(**self._client)

    def vertices(self) -> np.ndarray:
        """Positions of the mesh (V, 3) [m]."""
        bullet = self._bullet
        flags = bullet.MESH_DATA_SIMULATION_MESH
        return np.array(bullet.getMeshData(self._soft, -1, flags=flags, **self._client)[1])

    def beads(self) -> np.ndarray:
        """Positions of the beads of a bag's opening (32, 3) [m]."""
        pose = self._bullet.getBasePositionAndOrientation
        return np.array([pose(bead, **self._client)[0] for bead in self._beads])

    def cube(self) -> np.ndarray:
        """Centre of the cube (3,) [m]."""
        return np.array(self._bullet.getBasePositionAndOrientation(self._cube, **self._client)[0])

    def close(self) -> None:
        """Disconnect the client."""
        self._bullet.disconnect(**self._client)
