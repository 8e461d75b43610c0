"""A world's full state between two actions, to go back to it or to go on from it elsewhere."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .errors import InputError
from .running import RunningEpisode
from .solver.data import SolverData

__all__ = ["WorldState"]

_BODY_ARRAYS = ("x", "q", "v", "omega")


@dataclass(frozen=True, eq=False)
class WorldState:
    """What `Worlds.state` saves: all that the next action's outcome depends on, bit for bit.

    Arrays have the solver's precision. Nothing else lasts between two launches: contacts are found
    anew and nothing is held.

    particle_q, particle_qd (P, 3) [m], [m/s]
    body_x (B, 3) centres of mass [m]; body_quat (B, 4) quat_xyzw; body_v (B, 3) [m/s];
    body_omega (B, 3) [rad/s]
    episode: seed, layout, goal, actions, tip, posture and the like
    """

    particle_q: np.ndarray
    particle_qd: np.ndarray
    body_x: np.ndarray
    body_quat: np.ndarray
    body_v: np.ndarray
    body_omega: np.ndarray
    episode: RunningEpisode

    @staticmethod
    def of(data: SolverData, world: int, episode: RunningEpisode) -> WorldState:
        """Copy the state of one world."""
        rows = data.body_rows(world)
        return WorldState(
            data.lane("particles.x", world).copy(),
            data.lane("particles.v", world).copy(),
            *(data.views[f"bodies.{name}"][rows].copy() for name in _BODY_ARRAYS),
            episode=_copy(episode),
        )

    def put(self, data: SolverData, world: int) -> RunningEpisode:
        """Write the arrays into a world of equal objects; returns a copy of the episode.

        Raises:
            InputError: the world has other numbers of particles or bodies, or another precision.
        """
        rows = data.body_rows(world)
        bodies = [data.views[f"bodies.{name}"][rows] for name in _BODY_ARRAYS]
        places = [data.lane("particles.x", world), data.lane("particles.v", world), *bodies]
        saved = [self.particle_q, self.particle_qd]
        saved += [self.body_x, self.body_quat, self.body_v, self.body_omega]
        for place, values in zip(places, saved, strict=True):
            if (place.shape, place.dtype) != (values.shape, values.dtype):
                raise InputError(
                    f"a state of {values.shape} {values.dtype} does not fit a world of "
                    f"{place.shape} {place.dtype}; restore it in worlds of the same task"
                )
        for place, values in zip(places, saved, strict=True):
            place[:] = values
        return _copy(self.episode)


def _copy(episode: RunningEpisode) -> RunningEpisode:
    """An episode that goes on by itself; its parts are replaced, never changed, when it does."""
    copied = replace(episode)
    copied.snapshot = episode.snapshot
    return copied
