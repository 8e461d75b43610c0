"""The scenes on which this package and its peers are timed, as positions and links only.

Every engine starts from the same numbers, so what differs is the engine.

Source: Seita et al., ICRA 2021 (beads, spacing, masses, the stack that falls into a heap).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from ..errors import InputError
from ..objects.box import BoxConfig, l_block
from ..objects.cable import CableConfig, RingConfig, cable_ring

__all__ = ["SceneName"]  # the rest is imported from `warp_deform.peers`

SceneName = Literal["cable", "heap", "ring", "block", "tower"]
PEER_SCENES: tuple[str, ...] = get_args(SceneName)

_CENTRE = (0.5, 0.0)
_NOISE = 1e-4  # [m]; a perfect stack of spheres stands, and a perfect ring folds in its plane
_DROP = 0.05  # [m]; clear height under the block
_CUBES = 5
_GAP, _ASIDE = 0.005, 0.004  # [m]; clear height under each cube of the tower, and how far it is off
_ROOM = 0.08  # [m]; radius of the disc that holds a crumpled cable
_FALL = 0.01  # [m]; clear height under its lowest bead
_TURN = 1.1  # [rad]; spread of the turn from link to link
_STEPS = 2000  # tries of a walk before another one begins


@dataclass(frozen=True)
class PeerScene:
    """Where everything starts. A scene has either beads or blocks of one kind.

    Attributes:
        name: "cable", "heap", "ring", "block" or "tower".
        cable: What the beads are; None where the scene has none.
        beads: Bead centres (beads, 3) [m]; neighbours are one spacing apart.
        links: Pairs of linked beads (links, 2).
        block: What the blocks are; None where the scene has none.
        positions: Origins of the blocks (blocks, 3) [m], from the lowest one.
        yaws: Their headings (blocks,) [rad].
    """

    name: str
    cable: CableConfig | None
    beads: np.ndarray
    links: np.ndarray
    block: BoxConfig | None
    positions: np.ndarray
    yaws: np.ndarray

    @property
    def bodies(self) -> int:
        """Number of things that move."""
        return len(self.beads) + len(self.positions)

    @property
    def rest_heights(self) -> np.ndarray:
        """Of the blocks' origins once they lie on the table, and on each other (blocks,) [m]."""
        assert self.block is not None
        return -self.block.lowest * (2 * np.arange(len(self.positions)) + 1)

    def stretch(self, beads: np.ndarray) -> float:
        """Longest link over its rest length for beads at (beads, 3) [m]; 1 without links."""
        if self.cable is None:
            return 1.0
        ends = beads[self.links]
        return float(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).max() / self.cable.spacing)


def peer_scene(name: str, *, seed: int = 0) -> PeerScene:
    """A start above the table; `seed` draws its small noise and its heading.

    The cable lies crumpled within 8 cm and drops by 1 cm, as it lies between two actions; the heap
    is the same cable as a vertical stack that falls into the tightest tangle there is; the ring
    stands upright on its edge; the L-block hangs flat 5 cm above the table; five cubes of 4 cm hang
    above each other, each turned at random and up to 4 mm aside, and fall into a tower that stands.

    Raises:
        InputError: there is no scene of that name.
    """
    if name not in PEER_SCENES:
        raise InputError(f"no peer scene is called {name!r}; choose from {', '.join(PEER_SCENES)}")
    rng = np.random.default_rng(seed)
    yaw = float(rng.uniform(0, 2 * np.pi))
    cable: CableConfig | None = None
    block: BoxConfig | None = None
    positions, yaws = np.zeros((0, 3)), np.zeros(0)
    beads, links = np.zeros((0, 3)), np.zeros((0, 2), dtype=int)
    if name == "cable":
        cable = CableConfig()
        beads = _crumple(cable, rng)
    elif name == "heap":
        cable = CableConfig()
        beads = _stack(cable, rng)
    elif name == "ring":
        cable = RingConfig()
        beads = _upright_ring(cable, yaw, rng)
    elif name == "block":
        block, yaws = l_block(), np.array([yaw])
        positions = np.array([[*_CENTRE, _DROP - block.lowest]])
    else:
        block, yaws = BoxConfig(friction=0.5), rng.uniform(0, 2 * np.pi, _CUBES)
        positions = _tower(block, rng)
    if cable is not None:
        first = np.arange(cable.beads if cable.closed else cable.beads - 1)
        links = np.column_stack([first, (first + 1) % cable.beads])
    return PeerScene(name, cable, beads, links, block, positions, yaws)


def _crumple(cable: CableConfig, rng: np.random.Generator) -> np.ndarray:
    """A self-avoiding walk of exact links within a disc; one that gets stuck starts anew."""
    while True:
        beads = [np.array([*_CENTRE, 0.0])]
        heading = rng.uniform(0, 2 * np.pi)
        for _ in range(_STEPS):
            turned = heading + rng.normal(0, _TURN)
            step = np.array([np.cos(turned), np.sin(turned), rng.normal(0, 0.1)])
            bead = beads[-1] + cable.spacing * step / np.linalg.norm(step)
            apart = np.linalg.norm(bead - beads[:-1], axis=1) if len(beads) > 1 else np.ones(1)
            fold = 1.3 * cable.spacing
            if (
                np.hypot(*(bead[:2] - _CENTRE)) < _ROOM
                and apart.min() > 2.1 * cable.radius
                and apart[-1] > fold
            ):
                beads.append(bead)
                heading = turned
            if len(beads) == cable.beads:
                walk = np.array(beads)
                return walk + np.array([0, 0, cable.radius + _FALL - walk[:, 2].min()])


def _stack(cable: CableConfig, rng: np.random.Generator) -> np.ndarray:
    beads = np.empty((cable.beads, 3))
    beads[0] = (*_CENTRE, cable.spacing)
    for i in range(1, cable.beads):
        target = np.array([*(_CENTRE + rng.normal(0, _NOISE, 2)), (i + 1) * cable.spacing])
        step = target - beads[i - 1]
        beads[i] = beads[i - 1] + cable.spacing * step / np.linalg.norm(step)
    return beads


def _tower(cube: BoxConfig, rng: np.random.Generator) -> np.ndarray:
    number = np.arange(1, _CUBES + 1)
    heights = number * _GAP - cube.lowest * (2 * number - 1)
    return np.column_stack([_CENTRE + rng.uniform(-_ASIDE, _ASIDE, (_CUBES, 2)), heights])


def _upright_ring(cable: CableConfig, yaw: float, rng: np.random.Generator) -> np.ndarray:
    across, up, _ = cable_ring(cable, (0.0, 0.0)).T
    off_plane = rng.normal(0, _NOISE, cable.beads)
    return np.column_stack(
        [
            _CENTRE[0] + across * np.cos(yaw) - off_plane * np.sin(yaw),
            _CENTRE[1] + across * np.sin(yaw) + off_plane * np.cos(yaw),
            up - up.min() + 2 * cable.radius,
        ]
    )
