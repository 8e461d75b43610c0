"""The workspace in software: a bead chain on foam, under a hand with two fingers.

A twin is a `World` of the emulator, so that the vendor's own client moves the simulated chain, and
what `twin.robot.SimRobot` moves. It lives in the base frame; its ground is the foam's upper side.

    with EmulatorProcess(world=CableTwin) as emulator:
        emulator.call_world("toss", seed=3)
        ...
        look = emulator.call_world("look")

Where the hand is above everything and the chain at rest, a step costs next to nothing.
"""

from __future__ import annotations

import multiprocessing
from dataclasses import dataclass, field

import newton
import numpy as np

from warp_deform.errors import InputError
from warp_deform.objects.cable import CableConfig, add_cable
from warp_deform.quiet import quiet_warp
from warp_deform.robots.jaw import Jaw, JawConfig
from warp_deform.solver.solver import SolverFusedXPBD
from warp_deform.support.flag_range import check_seed
from warp_deform.tasks.chain_physics import BEAD_CHAIN, CHAIN_SOLVER
from warp_deform.tasks.chain_shapes import straight_chain, tossed_chain
from warp_deform.xpbd.config import FOREVER, SolverConfig
from warp_deform.xpbd.guards import PhysicsError

from ..arm.panda import HOME_Q, PandaKinematics
from ..arm.table_plane import TablePlane
from ..emulator.world import Contact, Hand
from ..vision.top_down_view import TopDownView

__all__ = ["CableTwin", "TwinConfig", "TwinLook"]

_REST_SPEED = 5e-3  # [m/s]
_REST_SECONDS = 0.1


@dataclass(frozen=True, kw_only=True)
class TwinConfig:
    """What lies on the table."""

    chain: CableConfig = BEAD_CHAIN
    """The bead chain."""
    physics: SolverConfig = CHAIN_SOLVER
    """Friction, damping and the substep."""
    jaw: JawConfig = field(default_factory=JawConfig)
    """The fingers."""
    view: TopDownView = field(default_factory=TopDownView)
    """The workspace: where the chain is tossed."""
    foam_height_m: float = 0.03
    """Upper side of the foam in the base frame [m]."""
    home_q: tuple[float, ...] = HOME_Q
    """Where the arm stands at first [rad]."""
    seed: int = 0
    """Of grips that slip, and of the first toss."""

    def __post_init__(self) -> None:
        check_seed(self.seed)

    @property
    def table(self) -> TablePlane:
        """The foam's upper side."""
        return TablePlane(self.foam_height_m)


@dataclass(frozen=True, eq=False)
class TwinLook:
    """What there is to see.

    Attributes:
        beads: their centres along the chain in the base frame [m], (n, 3)
        base_T_tcp: where the hand is [m], (4, 4)
        gripper_width: [m]
        held: numbers of the beads between the fingers
    """

    beads: np.ndarray
    base_T_tcp: np.ndarray
    gripper_width: float
    held: tuple[int, ...]


class CableTwin:
    """A chain, foam and fingers; a `World`.

    Args:
        config: what lies there

    Raises:
        PhysicsError: of `step`, when the simulation cannot be trusted
    """

    def __init__(self, config: TwinConfig | None = None) -> None:
        self.config = config or TwinConfig()
        if multiprocessing.parent_process() is not None:
            quiet_warp()
        chain = self.config.chain
        builder = newton.ModelBuilder()
        SolverFusedXPBD.register_custom_attributes(builder)
        middle = np.mean([self.config.view.x, self.config.view.y], axis=1)
        self._chain = add_cable(builder, chain, straight_chain(chain, middle, np.pi / 2))
        model = builder.finalize(device="cpu")
        self._solver = SolverFusedXPBD(model, self.config.physics, lanes=1)
        self._solver.set_duration(FOREVER, FOREVER)
        rng = np.random.default_rng(self.config.seed)
        self._jaw = Jaw(self._solver, 0, self._chain, self.config.jaw, rng=rng)
        self._left = 0.0
        self._still = 0.0
        home = PandaKinematics().pose(np.array(self.config.home_q))
        self._hand = Hand(home, np.zeros(3), 0.08, False, 1e-3)
        self.toss(self.config.seed)

    # What the owner does.

    def look(self) -> TwinLook:
        """Return what there is to see now."""
        beads = self._solver.particle_q(0).astype(np.float64)
        beads[:, 2] += self.config.foam_height_m
        held = tuple(int(i) for i in self._jaw.held)
        return TwinLook(beads, self._hand.base_T_tcp.copy(), self._hand.gripper_width, held)

    def lay(self, beads: np.ndarray) -> None:
        """Put the chain's beads at (n, 3) [m] in the base frame, at rest; links pull it right.

        Raises:
            InputError: another number of beads, or not finite
        """
        beads = np.asarray(beads, dtype=np.float64)
        if beads.shape != (self.config.chain.beads, 3) or not np.isfinite(beads).all():
            raise InputError(
                f"a chain of {self.config.chain.beads} beads needs finite positions "
                f"({self.config.chain.beads}, 3), not {beads.shape}"
            )
        x = self._solver.data.lane("particles.x", 0)
        x[:] = beads - [0.0, 0.0, self.config.foam_height_m]
        self._solver.data.lane("particles.v", 0)[:] = 0.0
        self._jaw.reset()
        self._settle(0.5, calm=True)

    def toss(self, seed: int, again: int = 0) -> None:
        """Toss the chain lightly onto the foam, as people do before an episode.

        Args:
            seed: of the toss
            again: how often it was tossed by that seed before
        """
        rng = np.random.default_rng([check_seed(seed), again])
        view = self.config.view
        beads = tossed_chain(rng, self.config.chain, view.x, view.y)
        self.lay(np.add(beads, (0.0, 0.0, self.config.foam_height_m)))

    def _settle(self, seconds: float, *, calm: bool = False) -> None:
        """Let time pass until the chain is at rest."""
        dt = self._solver.config.dt
        steps = round(seconds / dt)
        for _ in range(10):
            self._solver.set_duration(FOREVER, FOREVER, calm=steps if calm else 0.0)
            self._solver.check(self._solver.run(steps))
            if self._speed() < _REST_SPEED:
                break
        self._solver.set_duration(FOREVER, FOREVER)
        self._still = _REST_SECONDS

    def _speed(self) -> float:
        v = self._solver.data.lane("particles.v", 0)
        return float(np.sqrt(np.einsum("ij,ij->i", v, v).max()))

    # What the hand does.

    def step(self, hand: Hand) -> Contact:
        """Advance by `hand.dt` with the hand going to where it is now; returns what it feels."""
        self._hand = hand
        dt = self._solver.config.dt
        self._left += hand.dt
        steps = int(self._left / dt + 1e-6)
        if steps < 1:
            return Contact(object_width=0.0)
        self._left -= steps * dt
        world_T_tcp = np.array(hand.base_T_tcp, dtype=np.float64)
        world_T_tcp[2, 3] -= self.config.foam_height_m
        busy = self._jaw.near(world_T_tcp)
        if not busy and self._still >= _REST_SECONDS:
            return Contact()
        felt = self._jaw.move(world_T_tcp, hand.gripper_width, closing=hand.closing, steps=steps)
        values = self._solver.run(steps)
        problems = values[0].problems(0, self._solver.config.limits)
        if problems:
            raise PhysicsError(problems)
        quiet = not busy and self._speed() < _REST_SPEED
        self._still = self._still + hand.dt if quiet else 0.0
        return Contact((0.0, 0.0, felt.force, 0.0, 0.0, 0.0), felt.width)
