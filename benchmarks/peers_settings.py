"""What is searched: the settings of every engine on every scene, and of their fine solutions.

Every grid holds what an expert of that engine would try: step, iterations, solver, the model of a
link, stiffness, compliance of contacts, and the tolerance where there is one.
"""

from __future__ import annotations

from dataclasses import asdict
from itertools import product
from typing import Any

from peers_ours import OursSettings

from warp_deform.peers import (
    MujocoSettings,
    MujocoSoftSettings,
    NewtonSettings,
    NewtonSoftSettings,
    PyBulletSettings,
    PyBulletSoftSettings,
)

__all__ = [
    "BLOCKS",
    "ENGINES",
    "LANES",
    "SCENES",
    "STARTS",
    "fine",
    "grid",
    "has_fine",
    "is_original",
    "settings_of",
]

LINKS = ("cable", "heap", "ring")
BLOCKS = ("block", "tower")
LARGE = ("fold25", "crumple25", "shell-cube")
SHEETS = ("fold10", "crumple10", *LARGE)
SCENES = (*LINKS, *BLOCKS, *SHEETS)
STARTS = dict.fromkeys(SCENES, 3) | dict.fromkeys(SHEETS, 2) | dict.fromkeys(LARGE, 1)
"""Plays of a setting, each from another start."""
LANES = 8
OUR_RATES = (120, 240, 600, 1200, 2400, 4800)
NOT_ENGINES: dict[str, tuple[str, ...]] = {
    "newton-xpbd": SHEETS,  # it offers no self-contact
    "newton-vbd": (),
    "pybullet": (),
    "mujoco": (),
    "ours": (),
}
ENGINES = tuple(NOT_ENGINES)


def grid(engine: str, scene: str) -> list[Any]:
    """The settings to try, cheap ones first; empty where the engine does not run the scene."""
    if scene in NOT_ENGINES[engine]:
        return []
    return list(dict.fromkeys(_GRIDS[engine](scene)))


def fine(engine: str, scene: str) -> Any:
    """The settings of an engine's own fine solution."""
    soft, large = scene in SHEETS, scene in LARGE
    if engine == "ours":
        return OursSettings(hz=9600 if soft else 19200, precision="float64")
    if engine == "mujoco":
        if soft:
            return MujocoSoftSettings(hz=960 if large else 2400, iterations=100, tolerance=1e-9)
        return MujocoSettings(hz=9600, iterations=50, tolerance=1e-12)
    if engine == "newton-vbd" and soft:
        return NewtonSoftSettings(
            substeps=30 if scene == "crumple10" else 16, iterations=10, contact_damping=10.0
        )
    if engine == "newton-vbd":
        if scene in BLOCKS:
            return NewtonSettings(
                solver="vbd",
                beads="bodies",
                substeps=32,
                iterations=10,
                contact_stiffness=1e4,
                contact_damping=1.0,
            )
        return NewtonSettings(
            solver="vbd",
            beads="particles",
            substeps=64,
            iterations=10,
            contact_stiffness=1e4,
            contact_damping=60.0,
        )
    if engine == "newton-xpbd":
        return NewtonSettings(solver="xpbd", beads="bodies", substeps=64, iterations=4)
    if soft:
        return PyBulletSoftSettings(hz=960)
    return PyBulletSettings(hz=9600, world="rigid")


def settings_of(engine: str, scene: str, values: dict[str, Any]) -> Any:
    """The settings that a row tells."""
    kind = type(fine(engine, scene))
    return kind(**values)


def has_fine(engine: str, scene: str) -> bool:
    """Whether the fine solution is computed.

    Of VBD and PyBullet on large meshes it would take a quarter of an hour, and already their
    cheapest believable setting is dearer than MuJoCo's at equal error.
    """
    return scene not in LARGE or engine not in ("newton-vbd", "pybullet")


def is_original(engine: str, scene: str, values: dict[str, Any]) -> bool:
    """Whether the settings that a row tells are those of the original environment."""
    if engine != "pybullet":
        return False
    return values == asdict(PyBulletSoftSettings() if scene in SHEETS else PyBulletSettings())


def _ours(scene: str) -> list[OursSettings]:
    # at lower rates the fine sheet stretches to several times its size, and a play takes minutes
    rates = [hz for hz in OUR_RATES if hz >= 600 or scene != "crumple25"]
    return [OursSettings(hz=hz, lanes=lanes) for lanes in (1, LANES) for hz in rates]


def _mujoco(scene: str) -> list[Any]:
    if scene in SHEETS:
        return _mujoco_soft(scene)
    if scene in BLOCKS:
        return [
            MujocoSettings(
                hz=hz, solver=solver, iterations=count, contact=contact, cone=cone, sleep=sleep
            )
            for hz, (solver, count), contact, cone, sleep in product(
                (60, 120, 180, 240, 480, 960),
                (("Newton", 3), ("Newton", 20), ("CG", 10), ("PGS", 10)),
                (2.0, 4.0),
                ("pyramidal", "elliptic"),
                (False, True),
            )
        ]
    points = [
        MujocoSettings(
            hz=hz,
            solver=solver,
            iterations=count,
            stiff=stiff,
            tolerance=tolerance,
            contact=contact,
        )
        for hz, (solver, count), stiff, tolerance, contact in product(
            (60, 120, 180, 240, 480, 960),
            (("Newton", 3), ("Newton", 10), ("CG", 10), ("CG", 20), ("PGS", 10)),
            (2.0, 3.0),
            (1e-6, 1e-4),
            (2.0, 4.0),
        )
        if (stiff, contact) in ((2.0, 2.0), (3.0, 2.0), (2.0, 4.0))
        and (tolerance == 1e-4 or stiff == contact)
    ]
    others = [
        MujocoSettings(hz=hz, iterations=10, cone=cone, integrator=integrator, jacobian=jacobian)
        for hz, cone, integrator, jacobian in product(
            (120, 240),
            ("pyramidal", "elliptic"),
            ("Euler", "discrete"),
            ("dense", "sparse"),
        )
    ]
    spheres = [
        MujocoSettings(hz=hz, solver=solver, iterations=count, links="connect", sleep=sleep)
        for hz, (solver, count), sleep in product(
            (120, 240), (("CG", 10), ("CG", 20), ("Newton", 5), ("PGS", 20)), (False, True)
        )
    ]
    return [*points, *others, *spheres]


def _mujoco_soft(scene: str) -> list[MujocoSoftSettings]:
    large = scene in LARGE
    rates = (120, 240, 480) if large else (120, 180, 240, 480, 960)
    counts = (("CG", 5), ("CG", 10), ("CG", 20), *(() if large else (("CG", 50), ("Newton", 5))))
    other: list[MujocoSoftSettings] = []
    if large:
        # of what was tried on `crumple25` only these two change the cost by more than a tenth
        other = [
            MujocoSoftSettings(hz=hz, iterations=10, **change)
            for hz, change in product((240, 480), ({"condim": 1}, {"cone": "elliptic"}))
        ]
    first = [
        MujocoSoftSettings(hz=hz, solver=solver, iterations=count, contact=contact)
        for hz, (solver, count), contact in product(rates, counts, (2.0, 4.0))
        if contact == 2.0 or (solver, count) == ("CG", 20)
    ]
    more = [
        MujocoSoftSettings(hz=hz, iterations=20, **change)
        for hz, change in product(
            (240,) if scene == "crumple25" else () if large else (120, 240),
            (
                {"radius": 0.003},
                {"condim": 1},
                {"selfcollide": "bvh"},
                {"selfcollide": "sap"},
                {"edges": "vert"},
                {"damping": 1e-2},
                {"damping": 0.0},
                {"cone": "elliptic"},
                {"tolerance": 1e-4},
                {"sleep": True},
                {"integrator": "discrete"},
                {"stiff": 4.0},
            ),
        )
        if not (scene != "fold10" and "edges" in change)  # planar sheets only
    ]
    return [*first, *more, *other]


STIFFNESSES = ((1e4, 10.0), (1e3, 10.0), (1e4, 0.0))  # and damping of contacts


def _newton_vbd(scene: str) -> list[Any]:
    if scene in SHEETS:
        large = scene in LARGE
        counts = ((4, 2), (4, 6), (10, 2)) if large else product((2, 4, 6, 10), (2, 4))
        return [
            NewtonSoftSettings(
                substeps=count, iterations=each, stiffness=stiffness, contact_damping=damping
            )
            for (count, each), (stiffness, damping) in product(
                counts, STIFFNESSES if scene == "crumple10" else STIFFNESSES[:1]
            )
        ]
    if scene in BLOCKS:
        return [
            NewtonSettings(
                solver="vbd",
                beads="bodies",
                substeps=count,
                iterations=each,
                contact_stiffness=stiffness,
                contact_damping=damping,
            )
            for (count, each), stiffness, damping in product(
                ((2, 1), (2, 2), (4, 2), (8, 2), (8, 4), (16, 8)), (1e3, 1e4), (0.0, 1.0, 10.0)
            )
        ]
    particles = [
        NewtonSettings(
            solver="vbd",
            beads="particles",
            substeps=count,
            iterations=each,
            link_stiffness=stiffness,
            contact_damping=damping,
            contact_stiffness=contact,
        )
        for count, each, stiffness, damping, contact in product(
            (2, 4, 8), (1, 2, 4), (2e4, 2e5), (10.0, 60.0), (1e4,)
        )
    ]
    bodies = [
        NewtonSettings(solver="vbd", beads="bodies", substeps=count, iterations=each)
        for count, each in ((4, 2), (10, 5))
    ]
    return [*particles, *bodies]


def _newton_xpbd(scene: str) -> list[NewtonSettings]:
    if scene in BLOCKS:
        return [
            NewtonSettings(solver="xpbd", beads="bodies", substeps=count, iterations=each)
            for count, each in product((2, 4, 8, 16), (2, 4))
        ]
    return [
        NewtonSettings(
            solver="xpbd", beads="bodies", substeps=count, iterations=each, joint_relaxation=relaxed
        )
        for count, each, relaxed in product((4, 8, 12, 16), (2, 4), (1.0,))
    ]


def _pybullet(scene: str) -> list[PyBulletSettings]:
    if scene in SHEETS:
        original = PyBulletSoftSettings()
        return [original] if scene in LARGE else [original, PyBulletSoftSettings(hz=240)]
    return [
        PyBulletSettings(hz=hz, iterations=count, world=world)
        for world, hz, count in product(
            ("rigid", "deformable"), (60, 120, 240, 480, 960), (5, 10, 50)
        )
        if (world == "rigid" and (scene in BLOCKS or (hz in (240, 480) and count < 50)))
        or (hz, count) == (240, 50)
    ]


_GRIDS = {
    "ours": _ours,
    "mujoco": _mujoco,
    "newton-vbd": _newton_vbd,
    "newton-xpbd": _newton_xpbd,
    "pybullet": _pybullet,
}
