"""A world's full state between two actions, to go back to it or to go on from it elsewhere."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..errors import InputError
from ..xpbd.continuing.world_run import WorldRun
from ..xpbd.packing.data import SolverData
from .episode import RunningEpisode

__all__ = ["WorldState"]


@dataclass(frozen=True, eq=False)
class WorldState:
    """What `Worlds.state` saves: all that the next action's outcome depends on, bit for bit.

    Arrays have the solver's precision. Nothing else lasts between two actions: contacts are found
    anew and nothing is held. Under control (see `TipControl`) `run` is what lasts.

    Attributes:
        particle_q: positions of the particles (P, 3) [m]
        particle_qd: their velocities (P, 3) [m/s]
        still: how long the particles of fabrics have been near their anchors (P,) [s]
        anchor: these (P, 3) [m]; see `xpbd.springs.sleep`
        body_x: centres of mass (B, 3) [m]
        body_quat: turns of the bodies (B, 4) quat_xyzw
        body_v: their velocities (B, 3) [m/s]
        body_omega: their angular velocities (B, 3) [rad/s]
        episode: seed, layout, goal, actions, tip, posture and the like
        run: what is held, listed and counted in the midst of control; None: there was none
    """

    particle_q: np.ndarray
    particle_qd: np.ndarray
    still: np.ndarray
    anchor: np.ndarray
    body_x: np.ndarray
    body_quat: np.ndarray
    body_v: np.ndarray
    body_omega: np.ndarray
    episode: RunningEpisode
    run: WorldRun | None = None

    @staticmethod
    def of(
        data: SolverData, world: int, episode: RunningEpisode, run: WorldRun | None = None
    ) -> WorldState:
        """Copy the state of one world."""
        x, quat, v, omega = (array.copy() for array in _bodies(data, world))
        return WorldState(
            particle_q=data.lane("particles.x", world).copy(),
            particle_qd=data.lane("particles.v", world).copy(),
            still=data.lane("particles.still", world).copy(),
            anchor=data.lane("particles.anchor", world).copy(),
            body_x=x,
            body_quat=quat,
            body_v=v,
            body_omega=omega,
            episode=_copy(episode),
            run=run,
        )

    def put(self, data: SolverData, world: int) -> RunningEpisode:
        """Write the arrays into a world of equal objects; returns a copy of the episode.

        Raises:
            InputError: the world has other numbers of particles or bodies, or another precision.
        """
        particles = [data.lane(f"particles.{n}", world) for n in ("x", "v", "still", "anchor")]
        places = [*particles, *_bodies(data, world)]
        bodies = [self.body_x, self.body_quat, self.body_v, self.body_omega]
        saved = [self.particle_q, self.particle_qd, self.still, self.anchor, *bodies]
        for place, values in zip(places, saved, strict=True):
            if (place.shape, place.dtype) != (values.shape, values.dtype):
                raise InputError(
                    f"a state of {values.shape} {values.dtype} does not fit a world of "
                    f"{place.shape} {place.dtype}; restore it in worlds of the same task"
                )
        for place, values in zip(places, saved, strict=True):
            place[:] = values
        return _copy(self.episode)


def _bodies(data: SolverData, world: int) -> list[np.ndarray]:
    """Writable views of one world's bodies: centres, turns, velocities, angular velocities."""
    rows = data.body_rows(world)
    return [data.views[f"bodies.{name}"][rows] for name in ("x", "q", "v", "omega")]


def _copy(episode: RunningEpisode) -> RunningEpisode:
    """An episode that goes on by itself; its parts are replaced, never changed, when it does."""
    copied = replace(episode)
    copied.snapshot = episode.snapshot
    return copied
