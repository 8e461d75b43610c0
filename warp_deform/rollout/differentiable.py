"""Derivatives of where a rollout ends by how it starts, what it is made of, and how it is led."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import InputError
from ..objects.push import Push
from ..support.checked import POSITIVE, check_number
from ..xpbd.config import WORLD_PARAMETERS
from ..xpbd.fused_xpbd import FusedXPBD
from ..xpbd.guards import WatchValues
from ..xpbd.lanes.tape import Kind
from ..xpbd.packing.parts import PARTS, set_parts
from ..xpbd.recording.recorder import Recorder
from .rollouts import GripPath, prepare
from .world_rows import WorldRows

__all__: list[str] = []  # `warp_deform.rollout` is the import path of what is here


@dataclass(frozen=True, eq=False)
class Gradients:
    """Derivatives of a loss, world by world (W) in the order in which the worlds were given.

    Attributes:
        positions: (W, P, 3), by the particles at the start
        velocities: (W, P, 3), by the particles at the start
        inverse_masses: (W, P), by those of free particles; what is pinned, or while it is held, has
            none
        radii: (W, P), by the radii of the particles
        spring_stiffness: (W, S), by the stiffness of each spring, in the order of the model's
        rest_lengths: (W, S), by their rest lengths; strain limits and floors are shares of these
        damping: (W,), by the parameters of the worlds
        table_friction: (W,), by the parameters of the worlds
        contact_friction: (W,), by the parameters of the worlds
        stiffness: (W,), by the parameters of the worlds
        body_poses: (W, B, 7), by the poses of the bodies' frames at the start, position and
            quat_xyzw; the last four along the sphere of unit quaternions
        body_velocities: (W, B, 6), by the twists there
        body_inverse_masses: (W, B), by those of free bodies at the same inertia
        waypoints: by world number, by the positions of the knots of its path (K, 3)
        knot_times: by world number, by their times (K,)
        knot_rotations: by world number, by their rotations (K, 4)
        fired: (W, kinds), how often constraints of each `Kind` acted, and contacts in which branch
    """

    positions: np.ndarray
    velocities: np.ndarray
    inverse_masses: np.ndarray
    radii: np.ndarray
    spring_stiffness: np.ndarray
    rest_lengths: np.ndarray
    damping: np.ndarray
    table_friction: np.ndarray
    contact_friction: np.ndarray
    stiffness: np.ndarray
    body_poses: np.ndarray
    body_velocities: np.ndarray
    body_inverse_masses: np.ndarray
    waypoints: dict[int, np.ndarray]
    knot_times: dict[int, np.ndarray]
    knot_rotations: dict[int, np.ndarray]
    fired: np.ndarray

    def counts(self) -> dict[str, int]:
        """How often constraints of each kind acted in all worlds together, without those at 0."""
        total = self.fired.sum(axis=0)
        return {kind.name.lower(): int(total[kind]) for kind in Kind if total[kind]}


class DifferentiableRollout:
    """Rollouts of worlds of one topology, and derivatives back through them.

    What is simulated is what `rollout` simulates, bit for bit, from fabrics that are awake where
    `forward` is given their state. Contact on or off, its side, clamps,
    release and the like are those of the rollout, so a derivative is that of the smooth piece that
    it ran on; a derivative over many contacts may be as large as the rollout is chaotic.

    Args:
        storage: see `Recorder`
        memory: see `Recorder`
        sleep: see `Recorder`
        dt: length of a substep [s]; None: the solver's
        damp_every: see `FusedXPBD.run`
    """

    def __init__(
        self,
        solver: FusedXPBD,
        *,
        storage: str = "auto",
        memory: int = 2**30,
        sleep: bool = True,
        dt: float | None = None,
        damp_every: int | None = None,
    ) -> None:
        self.solver = solver
        self.recorder = Recorder(
            solver, storage=storage, memory=memory, sleep=sleep, dt=dt, damp_every=damp_every
        )
        self.watch: list[WatchValues] = []
        self._worlds: list[int] = []
        self.times = np.zeros(0)
        self.velocities = np.zeros((0, 0, 0, 3))
        self.body_poses = np.zeros((0, 0, 0, 7))
        self.body_velocities = np.zeros((0, 0, 0, 6))

    def forward(
        self,
        worlds: Sequence[int],
        times: Sequence[float],
        *,
        paths: Mapping[int, GripPath] | None = None,
        pushes: Mapping[int, Sequence[Push]] | None = None,
        positions: np.ndarray | None = None,
        velocities: np.ndarray | None = None,
        body_poses: np.ndarray | None = None,
        body_velocities: np.ndarray | None = None,
        parameters: Mapping[str, np.ndarray] | None = None,
        until_rest: bool = False,
        calm: float | Mapping[int, float] = 0.0,
        calm_after: float = 0.0,
    ) -> np.ndarray:
        """Positions (W, T, P, 3) [m] at `times` [s] from the start, ascending: at the nearest
        whole numbers of substeps, whose times are then in `times` (T,) [s].

        At these times `velocities` (W, T, P, 3) [m/s] are then those of the particles, `body_poses`
        (W, T, B, 7) the poses of the bodies' frames, position and quat_xyzw, and `body_velocities`
        (W, T, B, 6) their twists.

        Args:
            positions: of the particles at the start (W, P, 3) [m]; None: as the worlds are
            velocities: of the particles at the start (W, P, 3) [m/s]; None: as the worlds are
            body_poses: of the bodies' frames at the start (W, B, 7), position [m] and quat_xyzw;
                None: as the worlds are
            body_velocities: twists at the start (W, B, 6), linear at the centre of mass [m/s],
                angular [rad/s]; None: as the worlds are
            parameters: by name "damping", "table_friction", "contact_friction", "stiffness" (W,),
                "inverse_masses" (W, P) [1/kg], or what all worlds of this topology have in common:
                "spring_stiffness" (S,) [N/m], "rest_lengths" (S,) [m], "radii" (P,) [m], see
                `set_parts`; they stay set
            until_rest: worlds freeze once they rest, as in `rollout`; otherwise they run on

        Raises:
            InputError: worlds of several topologies, times that do not ascend, too little memory.
        """
        data, dt = self.solver.data, self.recorder.dt
        self._worlds = [int(w) for w in worlds]
        if len({int(data.world_topology[w]) for w in self._worlds}) != 1:
            raise InputError(
                "derivatives are taken of worlds of one topology at a time, at least one"
            )
        rows = self._rows = WorldRows(data, self._worlds)
        marks = [round(check_number(t, "times", POSITIVE) / dt) for t in times]
        self._marks = marks
        self.times = np.array(marks) * dt
        for name, value in (parameters or {}).items():
            self._set(name, np.asarray(value, dtype=float))
        for name, start in (("particles.x", positions), ("particles.v", velocities)):
            for k, w in enumerate(self._worlds) if start is not None else ():
                data.lane(name, w)[:] = np.asarray(start)[k]
                data.wake(w)
        if body_poses is not None or body_velocities is not None:
            for k, w in enumerate(self._worlds):
                poses, twists = data.body_poses(w)
                data.set_bodies(
                    w,
                    poses if body_poses is None else np.asarray(body_poses)[k],
                    twists if body_velocities is None else np.asarray(body_velocities)[k],
                )
        self._turns = rows.of_bodies(data.arrays["bodies.q"].view)
        end = marks[-1] * dt if marks else 0.0
        prepare(
            self.solver,
            self._worlds,
            paths=paths,
            pushes=pushes,
            max_seconds=2 * end,
            min_seconds=0.0 if until_rest else 2 * end,
            calm=calm,
            calm_after=calm_after,
            dt=dt,
        )
        knot, end_knot = (data.arrays[f"grips.{n}"].view for n in ("knot", "knot_end"))
        self._knots = {
            w: slice(int(knot[s]), int(end_knot[s]))
            for w, s in ((w, data.slot[w]) for w in self._worlds)
            if w in (paths or {})
        }
        self._flips = {w: self._flipped(paths[w], own) for w, own in self._knots.items() if paths}
        self.watch = self.recorder.forward(marks)
        states = [self.recorder.states[m] for m in marks]
        self.body_poses = np.stack([rows.poses(state) for state in states], axis=1)
        self.body_velocities = np.stack([rows.twists(state) for state in states], axis=1)
        at, speed = (
            np.stack([rows.of_particles(state[name]) for state in states], axis=1)
            for name in ("particles.x", "particles.v")
        )
        self.velocities = speed
        return at

    def _flipped(self, path: GripPath, rows: slice) -> np.ndarray:
        """-1 for knots (K, 1) whose quaternion was flipped to interpolate the short way round."""
        used = self.solver.data.arrays["grips.rotation"].view[rows]
        given = used if path.rotations is None else np.asarray(path.rotations)
        return np.where((used * given).sum(axis=1, keepdims=True) < 0, -1.0, 1.0)

    def _set(self, name: str, values: np.ndarray) -> None:
        data = self.solver.data
        if name in PARTS:
            set_parts(data, self._worlds[0], name, values)
            return
        if name not in (*WORLD_PARAMETERS, "inverse_masses") or len(values) != len(self._worlds):
            raise InputError(
                f"no parameter {name!r} of shape {values.shape} for {len(self._worlds)} worlds"
            )
        for k, w in enumerate(self._worlds):
            if name == "inverse_masses":
                data.edits += 1
                data.lane("particles.w0", w)[:] = values[k]
                data.lane("particles.w", w)[:] = values[k]
            else:
                self.solver.set_world(w, **{name: float(values[k])})

    def backward(
        self,
        positions: np.ndarray | None = None,
        velocities: np.ndarray | None = None,
        *,
        bodies: np.ndarray | None = None,
        body_velocities: np.ndarray | None = None,
        parts: bool = True,
    ) -> Gradients:
        """Derivatives of a loss from those by the positions (W, T, P, 3) and the velocities at the
        times of `forward`. May be called again with others.

        Args:
            bodies: derivatives by `body_poses` (W, T, B, 7); what is across the sphere of unit
                quaternions does not count
            body_velocities: derivatives by the twists (W, T, B, 6)
            parts: False leaves those by single particles and springs out, which take longer: then
                `inverse_masses`, `radii`, `spring_stiffness` and `rest_lengths` are not numbers
        """
        rows, states = self._rows, self.recorder.states
        given = {"particles.x": positions, "particles.v": velocities}
        cotangents: dict[int, dict[str, np.ndarray]] = {}
        for t, mark in enumerate(self._marks):
            cotangents[mark] = {
                name: rows.to_particles(name, np.asarray(values)[:, t])
                for name, values in given.items()
                if values is not None
            }
            at = (None if g is None else np.asarray(g)[:, t] for g in (bodies, body_velocities))
            cotangents[mark] |= rows.body_cotangents(states[mark], *at)
        out = self.recorder.backward(cotangents, parts=parts)
        knots = {
            name: {w: out[name][own] for w, own in self._knots.items()}
            for name in ("position", "time", "rotation")
        }
        return Gradients(
            positions=rows.of_particles(out["x"]),
            velocities=rows.of_particles(out["v"]),
            inverse_masses=rows.of_particles(out["mass"]),
            radii=rows.of_particles(out["radius"]),
            spring_stiffness=rows.of_springs(out["spring_stiffness"]),
            rest_lengths=rows.of_springs(out["rest"]),
            **{name: rows.of_groups(out[name]) for name in WORLD_PARAMETERS},
            body_poses=rows.by_frames(self._turns, out["body.x"], out["body.q"]),
            body_velocities=np.concatenate(
                [rows.of_bodies(out["body.v"]), rows.of_bodies(out["body.omega"])], axis=-1
            ),
            body_inverse_masses=rows.of_bodies(out["body.w"]),
            waypoints=knots["position"],
            knot_times=knots["time"],
            knot_rotations={w: g * self._flips[w] for w, g in knots["rotation"].items()},
            fired=rows.of_groups(out["fired"]),
        )


def substep_vjp(
    solver: FusedXPBD,
    worlds: Sequence[int],
    positions: np.ndarray,
    velocities: np.ndarray | None = None,
    *,
    sleep: bool = True,
    **options: Any,
) -> Gradients:
    """One substep of `worlds` as they are, and derivatives back through it.

    The worlds are left after the substep.

    Args:
        positions: (W, P, 3), derivatives of a loss by those after the substep
        velocities: (W, P, 3), as `positions`
        **options: as in `DifferentiableRollout.forward`, for example paths
    """
    run = DifferentiableRollout(solver, storage="full", sleep=sleep)
    run.forward(worlds, [solver.config.dt], **options)
    return run.backward(
        np.asarray(positions)[:, None],
        None if velocities is None else np.asarray(velocities)[:, None],
    )
