"""Derivatives of where a rollout ends by how it starts, what it is made of, and how it is led."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from .errors import InputError
from .rollout import GripPath, prepare
from .solver.recorder import Recorder
from .solver.tape import Kind

if TYPE_CHECKING:
    from .objects.push import Push
    from .solver.guards import WatchValues
    from .solver.solver import SolverFusedXPBD

__all__ = ["DifferentiableRollout", "Gradients", "substep_vjp"]

WORLD_PARAMETERS = ("damping", "table_friction", "contact_friction", "stiffness")


@dataclass(frozen=True, eq=False)
class Gradients:
    """Derivatives of a loss, world by world (W) in the order in which the worlds were given.

    positions, velocities (W, P, 3): by the particles at the start
    inverse_masses (W, P): by those of free particles; what is pinned, or while it is held, has none
    damping, table_friction, contact_friction, stiffness (W,): by the parameters of the worlds
    way_points, knot_times, knot_rotations: by world number, by the knots of its path (K, 3), (K,),
    (K, 4)
    fired (W, kinds): how often constraints of each `Kind` acted, and contacts in which branch
    """

    positions: np.ndarray
    velocities: np.ndarray
    inverse_masses: np.ndarray
    damping: np.ndarray
    table_friction: np.ndarray
    contact_friction: np.ndarray
    stiffness: np.ndarray
    way_points: dict[int, np.ndarray]
    knot_times: dict[int, np.ndarray]
    knot_rotations: dict[int, np.ndarray]
    fired: np.ndarray

    def counts(self) -> dict[str, int]:
        """How often constraints of each kind acted in all worlds together, without those at 0."""
        total = self.fired.sum(axis=0)
        return {kind.name.lower(): int(total[kind]) for kind in Kind if total[kind]}


class DifferentiableRollout:
    """Rollouts of worlds of one topology, and derivatives back through them.

    What is simulated is what `rollout` simulates, bit for bit. Contact on or off, its side, clamps,
    release and the like are those of the rollout, so a derivative is that of the smooth piece that
    it ran on; a derivative over many contacts may be as large as the rollout is chaotic.

    storage, memory, sleep: see `Recorder`. `sleep` False lets fabrics creep instead of sleeping.
    """

    def __init__(
        self,
        solver: SolverFusedXPBD,
        *,
        storage: str = "replay",
        memory: int = 2**30,
        sleep: bool = True,
    ) -> None:
        self.solver = solver
        self.recorder = Recorder(solver, storage=storage, memory=memory, sleep=sleep)
        self.watch: list[WatchValues] = []
        self._worlds: list[int] = []

    def forward(
        self,
        worlds: Sequence[int],
        times: Sequence[float],
        *,
        paths: Mapping[int, GripPath] | None = None,
        pushes: Mapping[int, Sequence[Push]] | None = None,
        positions: np.ndarray | None = None,
        velocities: np.ndarray | None = None,
        parameters: Mapping[str, np.ndarray] | None = None,
        until_rest: bool = False,
        calm: float | Mapping[int, float] = 0.0,
        calm_after: float = 0.0,
    ) -> np.ndarray:
        """Positions (W, T, P, 3) [m] at `times` [s] from the start, ascending.

        positions (W, P, 3) [m], velocities (W, P, 3) [m/s]: the start; None: as the worlds are
        parameters: by name "damping", "table_friction", "contact_friction", "stiffness" (W,) or
        "inverse_masses" (W, P) [1/kg]; they stay set
        until_rest: worlds freeze once they rest, as in `rollout`; otherwise they run on

        Raises:
            InputError: worlds of several topologies, times that do not ascend, too little memory.
        """
        data, dt = self.solver.data, self.solver.config.dt
        self._worlds = [int(w) for w in worlds]
        if len({int(data.world_topology[w]) for w in self._worlds}) != 1:
            raise InputError(
                "derivatives are taken of worlds of one topology at a time, at least one"
            )
        marks = [round(float(t) / dt) for t in times]
        self._marks = marks
        for name, value in (parameters or {}).items():
            self._set(name, np.asarray(value, dtype=float))
        for name, start in (("particles.x", positions), ("particles.v", velocities)):
            for k, w in enumerate(self._worlds) if start is not None else ():
                data.lane(name, w)[:] = np.asarray(start)[k]
        end = marks[-1] * dt if marks else 0.0
        prepare(
            self.solver, self._worlds, paths=paths, pushes=pushes, most=2 * end,
            least=0.0 if until_rest else 2 * end, calm=calm, calm_after=calm_after,
        )  # fmt: skip
        self._knots = {
            w: slice(int(data.views["grips.knot"][s]), int(data.views["grips.knot_end"][s]))
            for w, s in ((w, data.slot[w]) for w in self._worlds)
            if w in (paths or {})
        }
        self.watch = self.recorder.forward(marks)
        states = [self._worldwise(self.recorder.states[m]["particles.x"]) for m in marks]
        return np.stack(states, axis=1)

    def _set(self, name: str, values: np.ndarray) -> None:
        data = self.solver.data
        if name not in (*WORLD_PARAMETERS, "inverse_masses") or len(values) != len(self._worlds):
            raise InputError(
                f"no parameter {name!r} of shape {values.shape} for {len(self._worlds)} worlds"
            )
        for k, w in enumerate(self._worlds):
            if name == "inverse_masses":
                data.lane("particles.w0", w)[:] = values[k]
                data.lane("particles.w", w)[:] = values[k]
            else:
                self.solver.set_world(w, **{name: float(values[k])})

    def backward(
        self, positions: np.ndarray | None = None, velocities: np.ndarray | None = None
    ) -> Gradients:
        """Derivatives of a loss from those by the positions (W, T, P, 3) and the velocities at the
        times of `forward`. May be called again with others.
        """
        given = {"particles.x": positions, "particles.v": velocities}
        cotangents: dict[int, dict[str, np.ndarray]] = {}
        for t, mark in enumerate(self._marks):
            cotangents[mark] = {
                name: self._lanewise(name, np.asarray(values)[:, t])
                for name, values in given.items()
                if values is not None
            }
        out = self.recorder.backward(cotangents)
        knots = {
            name: {w: out[name][rows] for w, rows in self._knots.items()}
            for name in ("position", "time", "rotation")
        }
        return Gradients(
            positions=self._worldwise(out["x"]),
            velocities=self._worldwise(out["v"]),
            inverse_masses=self._worldwise(out["mass"]),
            **{name: self._of_groups(out[name]) for name in WORLD_PARAMETERS},
            way_points=knots["position"],
            knot_times=knots["time"],
            knot_rotations=knots["rotation"],
            fired=self._of_groups(out["fired"]),
        )

    def _worldwise(self, lanes: np.ndarray) -> np.ndarray:
        """An array of particles in lanes (P..., 3, L) or (P..., L) -> (W, P, 3) or (W, P)."""
        data, rows = self.solver.data, []
        for w in self._worlds:
            group, lane = divmod(int(data.slot[w]), data.lanes)
            first, last = data.group_particle[group : group + 2]
            rows.append(lanes[first:last, ..., lane])
        return np.stack(rows)

    def _lanewise(self, name: str, values: np.ndarray) -> np.ndarray:
        data = self.solver.data
        out = np.zeros_like(data.views[name])
        for k, w in enumerate(self._worlds):
            group, lane = divmod(int(data.slot[w]), data.lanes)
            first, last = data.group_particle[group : group + 2]
            out[first:last, ..., lane] = values[k]
        return out

    def _of_groups(self, lanes: np.ndarray) -> np.ndarray:
        """An array (groups, ..., L) -> (W, ...)."""
        data = self.solver.data
        slots = [divmod(int(data.slot[w]), data.lanes) for w in self._worlds]
        return np.stack([lanes[group, ..., lane] for group, lane in slots])


def substep_vjp(
    solver: SolverFusedXPBD,
    worlds: Sequence[int],
    positions: np.ndarray,
    velocities: np.ndarray | None = None,
    *,
    sleep: bool = True,
    **options: Any,
) -> Gradients:
    """One substep of `worlds` as they are, and derivatives back through it.

    positions, velocities (W, P, 3): derivatives of a loss by those after the substep
    options: as in `DifferentiableRollout.forward`, for example paths

    The worlds are left after the substep.
    """
    run = DifferentiableRollout(solver, storage="full", sleep=sleep)
    run.forward(worlds, [solver.config.dt], **options)
    return run.backward(
        np.asarray(positions)[:, None],
        None if velocities is None else np.asarray(velocities)[:, None],
    )
