"""The scenes in PyBullet, at the settings of the original DeformableRavens environment.

Source: Seita et al., ICRA 2021, and its released code: a deformable world for every task, 240 Hz,
gravity 9.8 m/s^2, every other solver setting left at PyBullet's default (50 iterations), beads that
are 0.1 kg cubes of half extent 5 mm, point-to-point constraints of at most 100 N, a ground plane
1 mm below a slab, both of friction 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from ..errors import InputError
from ..support.extras import install_extra
from .scene import PeerScene
from .timing import FRAME_RATE, PeerTiming, measure

__all__ = ["PyBulletWorld"]  # the rest is imported from `warp_deform.peers`

HZ = 240


@dataclass(frozen=True, kw_only=True)
class PyBulletSettings:
    """How PyBullet runs a scene; the defaults are the original's."""

    hz: int = HZ
    """Steps per second; a multiple of the frame rate."""
    iterations: int = 50
    world: Literal["deformable", "rigid"] = "deformable"
    """The original opens a deformable world for every task; a rigid one is cheaper."""

    def __post_init__(self) -> None:
        check_steps("PyBulletSettings", self.hz, self.iterations)


def check_steps(settings: str, hz: int, iterations: int) -> None:
    """Refuse rates and counts that settings of that name cannot have."""
    if hz < FRAME_RATE or hz % FRAME_RATE:
        raise InputError(f"{settings}.hz must be a multiple of {FRAME_RATE}, got {hz}")
    if iterations < 1:
        raise InputError(f"{settings}.iterations must be positive, got {iterations}")


_MAX_FORCE = 100.0  # [N]
_NOTE = (
    "as the original: cubes as beads, point-to-point joints of at most 100 N, no bending limit; "
    "without the arm, which the original also steps"
)


def time_pybullet(scene: str, *, seconds: float = 1.0, repeats: int = 5) -> PeerTiming:
    """CPU cost of `scene`, one of `PEER_SCENES`, in PyBullet, one process, one thread.

    Raises:
        InputError: PyBullet is not installed, or an argument is out of range.
    """
    bullet = import_pybullet()
    client = bullet.connect(bullet.DIRECT)
    try:
        bullet.resetSimulation(bullet.RESET_USE_DEFORMABLE_WORLD, physicsClientId=client)
        parameters = bullet.getPhysicsEngineParameters(physicsClientId=client)
    finally:
        bullet.disconnect(physicsClientId=client)
    return measure(
        PyBulletWorld,
        engine="pybullet",
        scene=scene,
        seconds=seconds,
        repeats=repeats,
        hz=HZ,
        iterations=int(parameters["numSolverIterations"]),
        note=_NOTE,
    )


def import_pybullet() -> Any:
    try:
        import pybullet
    except ImportError as error:
        raise InputError(
            f"PyBullet is not installed; in the clone run: {install_extra('dev')} "
            "(its wheels stop at Python 3.11)"
        ) from error
    return pybullet


class PyBulletWorld:
    """One scene in a PyBullet client of its own."""

    def __init__(self, scene: PeerScene, settings: PyBulletSettings | None = None) -> None:
        self._settings = settings = settings or PyBulletSettings()
        self._bullet = bullet = import_pybullet()
        self._client = {"physicsClientId": bullet.connect(bullet.DIRECT)}
        bullet.setPhysicsEngineParameter(enableFileCaching=0, **self._client)
        if settings.world == "deformable":
            bullet.resetSimulation(bullet.RESET_USE_DEFORMABLE_WORLD, **self._client)
        bullet.setPhysicsEngineParameter(numSolverIterations=settings.iterations, **self._client)
        bullet.setGravity(0, 0, -9.8, **self._client)
        bullet.setTimeStep(1 / settings.hz, **self._client)
        self._add_table()
        self._bodies = self._add_blocks(scene) if scene.cable is None else self._add_beads(scene)

    def _add_table(self) -> None:
        bullet = self._bullet
        plane = bullet.createCollisionShape(bullet.GEOM_PLANE, **self._client)
        slab = bullet.createCollisionShape(
            bullet.GEOM_BOX, halfExtents=(1.0, 1.5, 0.005), **self._client
        )
        for shape, position in ((plane, (0, 0, -0.001)), (slab, (0.5, 0, -0.005))):
            body = bullet.createMultiBody(0, shape, basePosition=position, **self._client)
            bullet.changeDynamics(body, -1, lateralFriction=1.0, **self._client)

    def _add_beads(self, scene: PeerScene) -> list[int]:
        bullet, cable = self._bullet, scene.cable
        assert cable is not None
        shape = bullet.createCollisionShape(
            bullet.GEOM_BOX, halfExtents=[cable.radius] * 3, **self._client
        )
        bodies = [
            bullet.createMultiBody(cable.mass, shape, basePosition=tuple(bead), **self._client)
            for bead in scene.beads
        ]
        for i, j in scene.links:
            joint = bullet.createConstraint(
                bodies[i],
                -1,
                bodies[j],
                -1,
                bullet.JOINT_POINT2POINT,
                jointAxis=(0, 0, 0),
                parentFramePosition=tuple(scene.beads[j] - scene.beads[i]),
                childFramePosition=(0, 0, 0),
                **self._client,
            )
            bullet.changeConstraint(joint, maxForce=_MAX_FORCE, **self._client)
        return bodies

    def _add_blocks(self, scene: PeerScene) -> list[int]:
        bullet, block = self._bullet, scene.block
        assert block is not None
        shape = bullet.createCollisionShapeArray(
            shapeTypes=[bullet.GEOM_BOX] * len(block.parts),
            halfExtents=[tuple(side / 2 for side in part.size) for part in block.parts],
            collisionFramePositions=[part.offset for part in block.parts],
            **self._client,
        )
        bodies = [
            bullet.createMultiBody(
                block.mass,
                shape,
                basePosition=tuple(position),
                baseOrientation=bullet.getQuaternionFromEuler((0, 0, yaw)),
                **self._client,
            )
            for position, yaw in zip(scene.positions, scene.yaws, strict=True)
        ]
        for body in bodies:
            bullet.changeDynamics(body, -1, lateralFriction=block.friction, **self._client)
        return bodies

    def frame(self) -> None:
        """Advance by 1 / FRAME_RATE simulated seconds."""
        for _ in range(self._settings.hz // FRAME_RATE):
            self._bullet.stepSimulation(**self._client)

    def beads(self) -> np.ndarray:
        """Positions of the moving bodies, (bodies, 3) [m]."""
        pose = self._bullet.getBasePositionAndOrientation
        return np.array([pose(body, **self._client)[0] for body in self._bodies])

    def close(self) -> None:
        """Disconnect the client."""
        self._bullet.disconnect(**self._client)
