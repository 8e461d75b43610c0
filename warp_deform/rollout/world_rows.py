"""`WorldRows`: where the arrays of groups and lanes hold some worlds' numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..support.quaternion import quat_rotate, quat_rotate_vjp, quat_tangent
from ..xpbd.packing.data import SolverData
from ..xpbd.recording.derivatives import spring_rows

__all__ = ["WorldRows"]


class WorldRows:
    """Brings arrays of worlds (W) of one topology out of lanes, and derivatives into them.

    Bodies have frames outside, and centres of mass in the arrays.
    """

    def __init__(self, data: SolverData, worlds: Sequence[int]) -> None:
        self._data, self.worlds = data, [int(w) for w in worlds]
        top = data.topologies[data.world_topology[self.worlds[0]]]
        self._group, self._lane = np.divmod(data.slot[self.worlds], data.lanes)
        first = data.group_particle[self._group]
        particles = first[:, None] + np.arange(top.particle_count)
        # numbers of single scalars, (W, P) and (W, P, 3): NumPy takes these several times faster
        self._scalars = particles * data.lanes + self._lane[:, None]
        axes = (particles[..., None] * 3 + np.arange(3)) * data.lanes
        self._vectors = axes + self._lane[:, None, None]
        of_groups = spring_rows(data)
        springs = np.array([of_groups[g][0].start for g in self._group])
        self._springs = springs[:, None] + np.arange(len(top.spring_ij))
        bodies = data.group_body[self._group] + self._lane * top.body_count
        self._bodies = bodies[:, None] + np.arange(top.body_count)
        self._com = np.asarray(top.body_com).reshape(-1, 3)

    def of_particles(self, lanes: np.ndarray) -> np.ndarray:
        """An array of particles in lanes (P..., 3, L) or (P..., L) -> (W, P, 3) or (W, P)."""
        return lanes.reshape(-1).take(self._vectors if lanes.ndim == 3 else self._scalars)

    def to_particles(self, name: str, values: np.ndarray) -> np.ndarray:
        """The other way round, as one of the solver's arrays; 0 elsewhere."""
        out = np.zeros_like(self._data.arrays[name].view)
        out.reshape(-1)[self._vectors if out.ndim == 3 else self._scalars] = values
        return out

    def of_springs(self, lanes: np.ndarray) -> np.ndarray:
        """An array of springs in lanes, see `spring_rows` -> (W, S)."""
        return lanes[self._springs, self._lane[:, None]]

    def of_groups(self, lanes: np.ndarray) -> np.ndarray:
        """An array (groups, ..., L) -> (W, ...)."""
        return lanes[self._group, ..., self._lane]

    def of_bodies(self, rows: np.ndarray) -> np.ndarray:
        """An array by row of bodies -> (W, B, ...)."""
        return rows[self._bodies]

    def poses(self, state: Mapping[str, np.ndarray]) -> np.ndarray:
        """Poses (W, B, 7) of the bodies' frames in a state by the names of arrays."""
        x, q = self.of_bodies(state["bodies.x"]), self.of_bodies(state["bodies.q"])
        if not len(self._com):
            return np.concatenate([x, q], axis=-1)
        return np.concatenate([x - quat_rotate(q, self._com), q], axis=-1)

    def twists(self, state: Mapping[str, np.ndarray]) -> np.ndarray:
        """Twists (W, B, 6) of the bodies in a state."""
        return np.concatenate(
            [self.of_bodies(state["bodies.v"]), self.of_bodies(state["bodies.omega"])], axis=-1
        )

    def body_cotangents(
        self,
        state: Mapping[str, np.ndarray],
        poses: np.ndarray | None,
        twists: np.ndarray | None,
    ) -> dict[str, np.ndarray]:
        """Derivatives by poses (W, B, 7) and twists (W, B, 6) in a state as those by the arrays."""
        out: dict[str, np.ndarray] = {}
        if not len(self._com):
            return out
        for names, given in ((("x", "q"), poses), (("v", "omega"), twists)):
            if given is None:
                continue
            g = np.asarray(given, dtype=float)
            first, rest = g[..., :3], g[..., 3:]
            if names[1] == "q":
                turn = state["bodies.q"][self._bodies]
                rest = quat_tangent(turn, rest - quat_rotate_vjp(turn, self._com, first))
            for name, values in zip(names, (first, rest), strict=True):
                key = f"bodies.{name}"
                out[key] = np.zeros_like(self._data.arrays[key].view)
                out[key][self._bodies] = values
        return out

    def by_frames(self, turns: np.ndarray, x: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Derivatives (W, B, 7) by the bodies' frames, from those by centres of mass and turns.

        Args:
            turns: of the bodies (W, B, 4)
            x: an array by row of bodies
            q: an array by row of bodies
        """
        by_x, by_q = self.of_bodies(x), self.of_bodies(q)
        if len(self._com):
            by_q = quat_tangent(turns, by_q + quat_rotate_vjp(turns, self._com, by_x))
        return np.concatenate([by_x, by_q], axis=-1)
