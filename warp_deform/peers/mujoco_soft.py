"""Fabrics and the bag's shell as flexes of MuJoCo, with self-contact, on one thread.

A flex's vertices are point masses with three slide joints each. Edges keep their lengths by
equality constraints: one an edge (`edge`), or as many as a planar sheet's vertices have, which
average over the edges around each (`vert`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..objects.cloth import ClothConfig
from .mujoco_peer import MujocoSettings, finite, import_mujoco
from .soft_scene import SoftScene
from .soft_timing import measure_soft
from .timing import FRAME_RATE, PeerTiming

__all__ = ["MujocoSoftWorld"]  # the rest is imported from `warp_deform.peers`

_SHEET, _BEAD, _CUBE = ClothConfig(), 0.01, 0.02  # masses of ours; those of bead and cube [kg]
_CUBE_HALF = 0.018  # [m]
_NOTE = (
    "self-contact of faces against faces, soft over two steps; no bending stiffness, no sleep; "
    "one friction for table and layers"
)


@dataclass(frozen=True, kw_only=True)
class MujocoSoftSettings(MujocoSettings):
    """How MuJoCo runs a fabric or a bag."""

    solver: Literal["CG", "Newton", "PGS"] = "CG"
    edges: Literal["edge", "vert"] = "edge"
    radius: float = 0.002
    """Of the flex [m]: layers touch at twice that."""
    damping: float = 1e-3
    """Of the edges [N s/m]."""
    condim: Literal[1, 3] = 3
    """3: contacts have friction."""
    selfcollide: Literal["auto", "narrow", "bvh", "sap", "none"] = "auto"
    friction: float = 0.5
    note: str = _NOTE


_SETTINGS = {
    "crumple10": MujocoSoftSettings(hz=180, iterations=10),
    **dict.fromkeys(("fold10", "fold25"), MujocoSoftSettings(hz=120, iterations=10)),
    **dict.fromkeys(("crumple25", "shell-cube"), MujocoSoftSettings(hz=240, iterations=10)),
}
"""Of scenes for which a search found cheaper ones than the defaults."""


def time_mujoco_soft(
    scene: str,
    *,
    seconds: float | None = None,
    repeats: int = 3,
    settings: MujocoSoftSettings | None = None,
) -> PeerTiming:
    """CPU cost of `scene`, one of `SOFT_SCENES`, as a flex of MuJoCo.

    Raises:
        InputError: MuJoCo is not installed, or an argument is out of range.
    """
    import_mujoco()
    chosen = settings or _SETTINGS.get(scene, MujocoSoftSettings())
    return measure_soft(
        lambda start: MujocoSoftWorld(start, chosen),
        engine="mujoco",
        scene=scene,
        seconds=seconds,
        repeats=repeats,
        hz=chosen.hz,
        iterations=chosen.iterations,
        note=chosen.note,
    )


class MujocoSoftWorld:
    """One fabric or bag as a flex."""

    def __init__(self, scene: SoftScene, settings: MujocoSoftSettings | None = None) -> None:
        self._mujoco = mujoco = import_mujoco()
        self._settings = settings or _SETTINGS.get(scene.name, MujocoSoftSettings())
        self._model = model = mujoco.MjModel.from_xml_string(_write(scene, self._settings))
        self._data = mujoco.MjData(model)
        if len(scene.ring):
            beads = [model.flex_vertbodyid[vertex] for vertex in scene.ring]
            model.body_mass[beads] += _BEAD
            mujoco.mj_setConst(model, self._data)
        self._cube = model.body("cube").id if scene.cube is not None else -1
        mujoco.mj_forward(model, self._data)

    def hold(self) -> None:
        """Tie vertex 0 to the hand, which is brought to it."""
        data = self._data
        data.mocap_pos[0] = self.vertices()[0]
        data.eq_active[0] = 1

    def release(self) -> None:
        """Let it go, at rest."""
        self._data.eq_active[0] = 0
        self._data.qvel[:3] = 0.0

    def frame(self, target: np.ndarray | None = None) -> None:
        """Advance by 1 / FRAME_RATE simulated seconds, the hand to `target` (3,) [m]."""
        steps = self._settings.hz // FRAME_RATE
        if target is None:
            self._mujoco.mj_step(self._model, self._data, nstep=steps)
            return
        hand = self._data.mocap_pos[0]
        way = (target - hand) / steps
        for _ in range(steps):
            hand += way
            self._mujoco.mj_step(self._model, self._data)

    def vertices(self) -> np.ndarray:
        """Positions of the mesh (V, 3) [m]."""
        self._mujoco.mj_kinematics(self._model, self._data)
        return finite(self._data, self._data.xpos[self._model.flex_vertbodyid].copy())

    def cube(self) -> np.ndarray:
        """Centre of the cube (3,) [m]."""
        return self._data.xpos[self._cube].copy()

    def close(self) -> None:
        """Nothing to give back: model and data end with this object."""


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{float(value):.9g}" for value in np.ravel(values))


def _write(scene: SoftScene, settings: MujocoSoftSettings) -> str:
    mass = scene.mass if len(scene.ring) else _SHEET.mass
    contact = f'solref="{settings.contact_reference}" friction="{settings.friction} 0 0"'
    cube, hand, grip = "", "", ""
    if scene.cube is not None:
        cube = (
            f'<body name="cube" pos="{_numbers(scene.cube)}"><freejoint/><geom type="box" '
            f'size="{_CUBE_HALF} {_CUBE_HALF} {_CUBE_HALF}" mass="{_CUBE}" {contact}/></body>'
        )
    if len(scene.times):
        hand = f'<body name="hand" mocap="true" pos="{_numbers(scene.vertices[0])}"/>'
        # first of all constraints, between frames that coincide at the start
        grip = (
            '<equality><connect name="grip" body1="sheet_0" body2="hand" anchor="0 0 0" '
            f'active="false" solref="{settings.link_reference}"/></equality>'
        )
    edges = {"edge": "true", "vert": "vert"}[settings.edges]
    return (
        f'<mujoco>{settings.option()}<size memory="400M"/><worldbody>'
        f'<geom type="plane" size="2 2 0.1" condim="{settings.condim}" {contact}/>{hand}{cube}'
        f'<flexcomp name="sheet" type="direct" dim="2" mass="{mass}" radius="{settings.radius}" '
        f'point="{_numbers(scene.vertices)}" '
        f'element="{" ".join(map(str, scene.triangles.ravel()))}">'
        f'<edge equality="{edges}" damping="{settings.damping}" '
        f'solref="{settings.link_reference}"/>'
        f'<contact selfcollide="{settings.selfcollide}" condim="{settings.condim}" {contact}/>'
        f"</flexcomp></worldbody>{grip}</mujoco>"
    )
