"""Continuous control: rollouts that go on, and a decision at every control step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from ..support.checked import NOT_NEGATIVE, POSITIVE, check_number, real_array
from ..support.quaternion import quat_inverse, quat_multiply, quat_rotate
from ..xpbd.continuing.continued_launch import ContinuedLaunch
from ..xpbd.continuing.lasting_grips import MOST
from ..xpbd.guards import Problem, WatchValues

if TYPE_CHECKING:
    from ..xpbd.continuing.world_run import WorldRun
    from ..xpbd.fused_xpbd import FusedXPBD

__all__: list[str] = []  # `warp_deform.rollout` is the import path of what is here

RELEASES = ("rest", "moving")
_UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])
_SAME = 1.0e-6
"""Relative difference below which a number of substeps is whole."""


def control_substeps(rate: float, dt: float) -> int:
    """Substeps of `dt` [s] that make up a control step at `rate` [Hz].

    Raises:
        InputError: they are no whole number.
    """
    exact = 1.0 / (check_number(rate, "rate", POSITIVE) * dt)
    if round(exact) < 1 or abs(exact - round(exact)) > _SAME * exact:
        raise InputError(
            f"a control step at {rate:.6g} Hz takes {exact:.6g} substeps of {dt:.6g} s; choose a "
            "rate at which it takes a whole number of them"
        )
    return round(exact)


class ControlLoop:
    """Worlds that are led by decisions at a fixed rate, in one launch that goes on.

        loop = ControlLoop(solver, rate=20.0)
        loop.begin([0, 1])
        loop.hold(0, particle=23)
        for targets in plan:  # (2, 3) each
            loop.advance(targets)
            positions = loop.particle_q()
        loop.let_go(0, release="moving")
        loop.advance()
        loop.end()

    N control steps have the bits of one `rollout` along a path with all of their knots. Nothing is
    let go, listed anew, or set to rest between them, as it is between two rollouts. A world's bits
    depend on no other world, on no pause, and not on when others begin, take, let go or end.

    From `begin` to `end` a world is refused to `rollout`, `step` and the like; others are not.
    The guards count as in one launch; nothing is raised where one fires, see `advance`.

    Args:
        rate: control steps a second [Hz], each of a whole number of substeps
        launch: with as many substeps; None: one that records nothing

    Raises:
        InputError: the rate has no whole number of substeps.
    """

    def __init__(
        self, solver: FusedXPBD, *, rate: float = 20.0, launch: ContinuedLaunch | None = None
    ) -> None:
        self.solver, self.rate = solver, float(rate)
        self.substeps = control_substeps(rate, solver.config.dt)
        self._launch = launch or ContinuedLaunch(solver, self.substeps)

    @property
    def worlds(self) -> np.ndarray:
        """Numbers of the worlds that have begun and not ended, ascending (W,)."""
        return np.flatnonzero(self._launch.open)

    @property
    def seconds(self) -> float:
        """Length of a control step [s]."""
        return self.substeps * self.solver.config.dt

    def begin(self, worlds: Sequence[int]) -> None:
        """Take worlds under control as they are; they hold nothing.

        Raises:
            InputError: there is no such world, or it has begun already.
        """
        self._launch.begin(worlds)

    def end(self, worlds: Sequence[int] | None = None) -> None:
        """Leave worlds (None: all) as they are; what one holds is let go at rest.

        Raises:
            InputError: one has not begun.
        """
        self._launch.end(self.worlds if worlds is None else worlds)

    def hold(
        self,
        world: int,
        *,
        particle: int | None = None,
        body: int | None = None,
        tip: Sequence[float] | np.ndarray | None = None,
        rotation: Sequence[float] | np.ndarray | None = None,
    ) -> None:
        """Hold a particle or a body from now on: it goes where the tip goes, as if glued to it.

        Args:
            particle: local number in the world
            body: local number in the world
            tip: where the tip is now (3,) [m]; None: at the particle, or at the centre of mass
            rotation: of the tip now (4,) quat_xyzw; None: along the axes

        Raises:
            InputError: the world has not begun, holds something already, or has none such.
        """
        data = self.solver.data
        turn = _UPRIGHT if rotation is None else _unit(rotation, (4,), "rotation")
        self._launch.check_holdable(world, particle, body)
        if particle is not None:
            place, pose = data.lane("particles.x", world)[particle].astype(float), turn
        else:
            row = data.body_rows(world).start + int(body or 0)
            place, pose = (data.views[f"bodies.{n}"][row].astype(float) for n in ("x", "q"))
        at = place if tip is None else real_array(tip, (3,), name="tip", finite=True)
        back = quat_inverse(turn)
        self._launch.hold(
            world,
            particle=particle,
            body=body,
            position=at,
            rotation=turn,
            offset=quat_rotate(back, place - at) if tip is not None else np.zeros(3),
            turn=quat_multiply(back, pose) if body is not None else _UPRIGHT,
        )

    def let_go(self, world: int, *, release: str = "rest", calm: float = 0.0) -> None:
        """Let go of what a world holds, if anything.

        Args:
            release: "rest" stops it; "moving" leaves it the velocity that it had at the tip, up to
                `SolverConfig.max_speed`
            calm: speeds are clamped to `calm_speed` for so long [s]

        Raises:
            InputError: the world has not begun, or there is no such release.
        """
        if release not in RELEASES:
            raise InputError(f'release must be "rest" or "moving", not {release!r}')
        steps = round(check_number(calm, "calm", NOT_NEGATIVE) / self.solver.config.dt)
        self._launch.let_go(world, moving=release == "moving", calm=steps)

    def holding(self, worlds: Sequence[int] | None = None) -> np.ndarray:
        """Which of the worlds (None: all that have begun) hold something (W,)."""
        return self._launch.holding(self.worlds if worlds is None else worlds)

    def advance(
        self,
        targets: np.ndarray | None = None,
        rotations: np.ndarray | None = None,
        *,
        worlds: Sequence[int] | None = None,
    ) -> dict[int, tuple[Problem, ...]]:
        """Run one control step: the tips go straight to their targets, at an even speed.

        With K targets a step the tip comes by the first after a Kth of the step, and so on.

        Args:
            targets: of the tips at the end of the step (W, 3), or on the way (W, K, 3) [m], row by
                row for `worlds`; rows of worlds that hold nothing mean nothing. None: tips wait
            rotations: of the tips (W, 4) or (W, K, 4) quat_xyzw; None: they do not turn
            worlds: that take part; None: all that have begun, ascending. The others pause

        Returns:
            Guards that have fired since a world has begun, of those where one has. Such a state
            cannot be trusted: end the world's control, and reset it.

        Raises:
            InputError: shapes that do not fit, numbers that are not finite, a world that has not
                begun; nothing has moved then.
        """
        selection = self._launch.select(worlds)
        positions = self._knots(targets, len(selection.worlds), 3, "targets")
        turns = self._knots(rotations, len(selection.worlds), 4, "rotations")
        if positions is not None and turns is not None and positions.shape[1] != turns.shape[1]:
            counts = positions.shape[1], turns.shape[1]
            raise InputError(f"targets and rotations have {counts} knots a step: as many of both")
        if positions is not None:
            positions = positions[selection.held]
        if turns is not None:
            turns = turns[selection.held]
            turns = _unit(turns, turns.shape, "rotations")
        self._launch.advance(selection, positions, turns)
        return self._launch.problems(selection.worlds)

    def _knots(
        self, values: np.ndarray | None, count: int, width: int, name: str
    ) -> np.ndarray | None:
        """The values as (W, K, width)."""
        if values is None:
            return None
        array = np.asarray(values, dtype=float)
        knots = array.shape[1] if array.ndim == 3 else 1
        if array.shape not in ((count, width), (count, knots, width)):
            raise InputError(
                f"{name} of {count} worlds must have the shape ({count}, {width}) or "
                f"({count}, K, {width}), not {array.shape}"
            )
        if not 1 <= knots <= MOST or self.substeps % knots:
            raise InputError(
                f"{knots} knots a control step do not divide its {self.substeps} substeps, or are "
                f"more than {MOST}"
            )
        if not np.isfinite(array).all():
            raise InputError(f"{name} holds numbers that are not finite")
        return array.reshape(count, knots, width)

    # -- reading

    def particle_q(self, worlds: Sequence[int] | None = None) -> np.ndarray:
        """Positions (W, P, 3) [m] of the particles of worlds (None: all that have begun)."""
        return self._launch.particles("x", worlds)

    def particle_qd(self, worlds: Sequence[int] | None = None) -> np.ndarray:
        """Velocities (W, P, 3) [m/s] of the particles of worlds (None: all that have begun)."""
        return self._launch.particles("v", worlds)

    def watch(self, world: int) -> WatchValues:
        """What the guards have noted of a world since it has begun."""
        return self._launch.watch(world)

    # -- saving

    def save(self, world: int) -> WorldRun:
        """What a world goes on from, besides the positions and velocities of its parts.

        Raises:
            InputError: it has not begun.
        """
        return self._launch.save(world)

    def restore(self, world: int, saved: WorldRun) -> None:
        """Take a world under control that has the positions and velocities it was saved with.

        Raises:
            InputError: it has begun already, or what was saved is of another scene or precision.
        """
        self._launch.restore(world, saved)


def _unit(values: object, shape: tuple[int, ...], name: str) -> np.ndarray:
    """Quaternions (..., 4) of unit length.

    Raises:
        InputError: one has no length.
    """
    array = real_array(values, shape, name=name, finite=True)
    length = np.linalg.norm(array, axis=-1, keepdims=True)
    if (length < 1e-9).any():
        raise InputError(f"{name} holds a quaternion of length 0")
    return array / length
