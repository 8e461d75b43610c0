"""The scenes in MuJoCo, one process, one thread.

A cable is beads that are free spheres joined by `connect` constraints, or, which is cheaper and as
believable, point masses (three slide joints each) whose links are spatial tendons of fixed length:
the very model of ours. Neighbours do not collide. Friction is that of our tasks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from ..errors import InputError
from ..support.extras import install_extra
from .scene import PeerScene
from .timing import FRAME_RATE, PeerTiming, measure

__all__ = ["MujocoWorld"]  # the rest is imported from `warp_deform.peers`

_TABLE, _BEADS = 0.5, 0.1  # friction of ours; MuJoCo takes the larger of two
_SLIDES = "".join(f'<joint type="slide" axis="{axis}"/>' for axis in ("1 0 0", "0 1 0", "0 0 1"))


@dataclass(frozen=True, kw_only=True)
class MujocoSettings:
    """How MuJoCo runs a scene."""

    hz: int = 240
    """Steps per second; a multiple of the frame rate."""
    solver: Literal["CG", "Newton", "PGS"] = "Newton"
    iterations: int = 20
    """Of the solver, at most; it ends earlier at `tolerance`."""
    tolerance: float = 1e-6
    links: Literal["connect", "tendon"] = "tendon"
    """Beads that turn, in joints; or point masses at fixed distances."""
    stiff: float = 2.0
    """Time constant of links, fabrics' edges and what is held, in steps; MuJoCo's least is 2."""
    contact: float = 2.0
    """Time constant of contacts, in steps."""
    cone: Literal["pyramidal", "elliptic"] = "pyramidal"
    integrator: Literal["Euler", "implicitfast", "discrete"] = "Euler"
    jacobian: Literal["auto", "dense", "sparse"] = "auto"
    sleep: bool = False
    """Whether what rests is no longer simulated."""
    note: str = "no bending limit; contact and links are soft over two steps"

    def __post_init__(self) -> None:
        if self.hz < FRAME_RATE or self.hz % FRAME_RATE:
            raise InputError(f"MujocoSettings.hz must be a multiple of {FRAME_RATE}, got {self.hz}")
        if self.iterations < 1:
            raise InputError(f"MujocoSettings.iterations must be positive, got {self.iterations}")

    def option(self, *, gravity: float = 9.8) -> str:
        """The element that tells MuJoCo all of this."""
        return (
            f'<option timestep="{1 / self.hz}" gravity="0 0 {-gravity}" solver="{self.solver}" '
            f'iterations="{self.iterations}" tolerance="{self.tolerance}" cone="{self.cone}" '
            f'integrator="{self.integrator}" jacobian="{self.jacobian}">'
            f'<flag autoreset="disable" sleep="{"enable" if self.sleep else "disable"}"/></option>'
        )

    @property
    def link_reference(self) -> str:
        """`solref` of links: time constant [s] and damping ratio."""
        return f"{self.stiff / self.hz} 1"

    @property
    def contact_reference(self) -> str:
        """The same of contacts."""
        return f"{self.contact / self.hz} 1"


_CABLE = MujocoSettings(solver="CG", iterations=10, tolerance=1e-4)
_SETTINGS = {
    "cable": replace(_CABLE, hz=120, iterations=20),
    "heap": MujocoSettings(hz=480, solver="PGS", iterations=10),
    "ring": replace(_CABLE, hz=480),
    "block": MujocoSettings(hz=120, sleep=True, note="one rigid body of two boxes"),
    "tower": MujocoSettings(hz=120, sleep=True, note="rigid boxes"),
}
"""The cheapest believable ones that `benchmarks/peers.py` found."""


def mujoco_settings(scene: str) -> MujocoSettings:
    """The cheapest settings found for `scene`."""
    return _SETTINGS[scene]


def time_mujoco(
    scene: str,
    *,
    seconds: float = 1.0,
    repeats: int = 5,
    settings: MujocoSettings | None = None,
) -> PeerTiming:
    """CPU cost of `scene`, one of `PEER_SCENES`, in MuJoCo.

    Raises:
        InputError: MuJoCo is not installed, or an argument is out of range.
    """
    import_mujoco()
    chosen = settings or mujoco_settings(scene)
    return measure(
        lambda start: MujocoWorld(start, chosen),
        engine="mujoco",
        scene=scene,
        seconds=seconds,
        repeats=repeats,
        hz=chosen.hz,
        iterations=chosen.iterations,
        note=chosen.note,
    )


def import_mujoco() -> Any:
    try:
        import mujoco
    except ImportError as error:
        raise InputError(
            f"MuJoCo is not installed; in the clone run: {install_extra('dev')}"
        ) from error
    # it would write a file where the process runs; `finite` says as much
    mujoco.set_mju_user_warning(lambda _: None)
    return mujoco


def finite(data: Any, positions: np.ndarray) -> np.ndarray:
    """The positions, or none that is a number once MuJoCo noticed that it diverges.

    By itself it starts anew then, as if nothing had been.
    """
    wrong = import_mujoco().mjtWarning
    seen = (wrong.mjWARN_BADQPOS, wrong.mjWARN_BADQVEL, wrong.mjWARN_BADQACC)
    return positions * np.nan if any(data.warning[int(w)].number for w in seen) else positions


class MujocoWorld:
    """One scene in MuJoCo.

    Args:
        held: number of a bead of a cable that is joined to a tip, which `lead` moves
    """

    def __init__(
        self,
        scene: PeerScene,
        settings: MujocoSettings | None = None,
        *,
        held: int | None = None,
    ) -> None:
        self._mujoco = import_mujoco()
        self._settings = settings or mujoco_settings(scene.name)
        if scene.cable is None:
            text = _blocks(scene, self._settings)
        else:
            text = _cable(scene, self._settings, held)
        self._model = self._mujoco.MjModel.from_xml_string(text)
        self._data = self._mujoco.MjData(self._model)
        self._mujoco.mj_forward(self._model, self._data)

    def lead(self, target: np.ndarray, seconds: float) -> None:
        """Advance by so many seconds, in which the tip goes straight to a target (3,) [m]."""
        steps, tip = round(seconds * self._settings.hz), self._data.mocap_pos[0]
        for way in np.linspace(tip, target, steps + 1)[1:]:
            tip[:] = way
            self._mujoco.mj_step(self._model, self._data)

    def frame(self) -> None:
        """Advance by 1 / FRAME_RATE simulated seconds."""
        self._mujoco.mj_step(self._model, self._data, nstep=self._settings.hz // FRAME_RATE)

    def beads(self) -> np.ndarray:
        """Positions of the moving bodies, (bodies, 3) [m]."""
        # after a step `xpos` is that of the step's beginning
        self._mujoco.mj_kinematics(self._model, self._data)
        return finite(self._data, self._data.xpos[1:].copy())

    def close(self) -> None:
        """Nothing to give back: model and data end with this object."""


def _numbers(values: Any) -> str:
    return " ".join(f"{float(value):.9g}" for value in np.ravel(values))


def _cable(scene: PeerScene, settings: MujocoSettings, held: int | None = None) -> str:
    cable = scene.cable
    assert cable is not None
    free = settings.links == "connect"
    bodies, apart, links, tendons = [], [], [], []
    for i, bead in enumerate(scene.beads):
        bodies.append(
            f'<body name="b{i}" pos="{_numbers(bead)}">{"<freejoint/>" if free else _SLIDES}'
            f'<geom type="sphere" size="{cable.radius}" mass="{cable.mass}" '
            f'friction="{_BEADS} 0 0"/><site name="s{i}"/></body>'
        )
    for i, j in scene.links:
        apart.append(f'<exclude body1="b{i}" body2="b{j}"/>')
        if free:
            anchor = _numbers(scene.beads[j] - scene.beads[i])
            links.append(f'<connect body1="b{i}" body2="b{j}" anchor="{anchor}"/>')
        else:
            tendons.append(f'<spatial name="t{i}"><site site="s{i}"/><site site="s{j}"/></spatial>')
            links.append(f'<tendon tendon1="t{i}"/>')
    if held is not None:
        bodies.append(f'<body name="tip" mocap="true" pos="{_numbers(scene.beads[held])}"/>')
        links.append(f'<connect body1="tip" body2="b{held}" anchor="0 0 0"/>')
    return _document(
        settings,
        body="".join(bodies),
        rest=f"<contact>{''.join(apart)}</contact><tendon>{''.join(tendons)}</tendon>"
        f"<equality>{''.join(links)}</equality>",
        table=_TABLE,
    )


def _blocks(scene: PeerScene, settings: MujocoSettings) -> str:
    block = scene.block
    assert block is not None
    volumes = [np.prod(part.size) for part in block.parts]
    parts = [
        f'<geom type="box" size="{_numbers(np.divide(part.size, 2))}" '
        f'pos="{_numbers(part.offset)}" mass="{block.mass * volume / sum(volumes)}" '
        f'friction="{block.friction} 0 0"/>'
        for part, volume in zip(block.parts, volumes, strict=True)
    ]
    half = scene.yaws / 2
    turns = np.column_stack([np.cos(half), 0 * half, 0 * half, np.sin(half)])
    bodies = [
        f'<body pos="{_numbers(position)}" quat="{_numbers(turn)}"><freejoint/>'
        f"{''.join(parts)}</body>"
        for position, turn in zip(scene.positions, turns, strict=True)
    ]
    return _document(settings, body="".join(bodies), rest="", table=0.0)


def _document(settings: MujocoSettings, *, body: str, rest: str, table: float) -> str:
    return (
        f"<mujoco>{settings.option()}<default>"
        f'<geom condim="3" solref="{settings.contact_reference}"/>'
        f'<equality solref="{settings.link_reference}"/></default>'
        f'<worldbody><geom type="plane" size="2 2 0.1" friction="{table} 0 0"/>{body}</worldbody>'
        f"{rest}</mujoco>"
    )
