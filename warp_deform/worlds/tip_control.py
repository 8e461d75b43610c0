"""`TipControl`: the tips of worlds, led by a decision at every control step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..errors import InputError
from ..objects.scene_object import SceneObject
from ..robots.primitive import Grasp, PrimitiveConfig, find_grasp
from ..support.checked import real_array
from ..support.quaternion import quat_from_yaw
from .worlds import Worlds

__all__ = ["GRASP_WITHIN", "nearest_grasp"]  # `warp_deform.worlds` has `TipControl`

GRASP_WITHIN = 0.015
"""Distance [m] within which a tip takes hold of the nearest thing."""
_TRIED = 8
"""Particles that are tried, nearest first, where there is nothing right under the tip."""


class TipControl:
    """Episodes whose tips are led at a fixed rate, in place of whole picks and places.

        worlds = Worlds("cable-line", 2)
        worlds.reset({0: 0, 1: 1})
        control = TipControl(worlds, rate=20.0)
        control.begin([0, 1])
        worlds.episodes[0].tip[:3] = worlds.episodes[0].snapshot.particle_q[0]
        held = control.hold(0)
        control.advance({0: (0.5, 0.1, 0.05, 0.0), 1: (0.4, 0.0, 0.2, 0.0)})
        control.let_go(0, release="moving")
        control.end()

    A tip is x, y, z [m] and a yaw [rad], in `RunningEpisode.tip`. What it holds goes with it; an
    empty tip meets nothing. `Worlds.state` saves what is held with everything else.

    Args:
        rate: control steps a second [Hz], see `ControlLoop`

    Raises:
        InputError: the rate has no whole number of substeps.
    """

    def __init__(self, worlds: Worlds, *, rate: float = 20.0) -> None:
        self.worlds, self.rate = worlds, rate
        self.loop = worlds.control_loop(rate)

    def begin(self, slots: Sequence[int]) -> None:
        """Take slots under control; their tips are where they were.

        Raises:
            InputError: a slot was not reset, or is under control.
        """
        for slot in slots:
            if slot not in self.worlds.episodes:
                raise InputError(f"slot {slot} has no episode: reset it first")
        self.loop.begin(slots)

    def hold(self, slot: int, *, within: float = GRASP_WITHIN) -> Grasp | None:
        """Take hold of the nearest thing at the tip, where it is; None: there is nothing.

        Args:
            within: distance [m]

        Raises:
            InputError: the slot is not under control, or holds something.
        """
        episode, data = self.worlds.episodes[slot], self.worlds.solver.data
        particle_q, body_q = data.lane("particles.x", slot), data.body_poses(slot)[0]
        config = self.worlds.task.primitive
        grasp = nearest_grasp(episode.tip, episode.objects, particle_q, body_q, config, within)
        if grasp is not None:
            turn = quat_from_yaw(float(episode.tip[3]))
            self.loop.hold(
                slot, particle=grasp.particle, body=grasp.body, tip=episode.tip[:3], rotation=turn
            )
        return grasp

    def let_go(self, slot: int, *, release: str = "rest", calm: float = 0.0) -> None:
        """Let go of what is held, if anything, see `ControlLoop.let_go`."""
        self.loop.let_go(slot, release=release, calm=calm)

    def advance(self, tips: Mapping[int, Sequence[float] | np.ndarray]) -> None:
        """Run one control step: each tip goes straight to where it is to be at its end.

        Slots under control that are left out pause. Guards that fire are in the `problems` of an
        episode. `Worlds.look` takes a new snapshot of a slot.

        Args:
            tips: (4,) x, y, z [m], yaw [rad], by slot

        Raises:
            InputError: a slot is not under control, or a tip holds no four finite numbers; nothing
                has moved then.
        """
        slots = list(tips)
        targets = np.array(
            [real_array(tips[s], (4,), name=f"tip of slot {s}", finite=True) for s in slots]
        ).reshape(-1, 4)
        fired = self.loop.advance(targets[:, :3], quat_from_yaw(targets[:, 3]), worlds=slots)
        for slot, target in zip(slots, targets, strict=True):
            episode = self.worlds.episodes[slot]
            episode.tip = target
            episode.sim_seconds += self.loop.seconds
            # these are of all control so far
            episode.problems = fired.get(slot, ()) or episode.problems

    def end(self, slots: Sequence[int] | None = None) -> None:
        """Leave slots (None: all) as they are; what one holds is let go at rest.

        Raises:
            InputError: a slot is not under control.
        """
        slots = self.loop.worlds.tolist() if slots is None else slots
        self.loop.end(slots)
        for slot in slots:
            self.worlds.episodes[slot].at_rest = False
            self.worlds.look(slot)


def nearest_grasp(
    tip: np.ndarray,
    objects: Sequence[SceneObject],
    particle_q: np.ndarray,
    body_q: np.ndarray,
    config: PrimitiveConfig,
    within: float = GRASP_WITHIN,
) -> Grasp | None:
    """What a tip (4,) x, y, z, yaw would meet right under it, or else beside it, or None.

    What it meets there (see `find_grasp`) is taken if that is at most `within` [m] above or below
    the tip; otherwise the nearest particle that could be met from above and is as near as that.

    Args:
        particle_q: (P, 3) [m]
        body_q: (B, 7)
    """
    under = find_grasp(tip[[0, 1, 3]], objects, particle_q, body_q, config)
    if under is not None and abs(under.height - tip[2]) <= within:
        return under
    away = np.linalg.norm(particle_q - tip[:3], axis=1)
    for i in np.argsort(away, kind="stable")[:_TRIED]:
        if away[i] > within:
            break
        above = np.array([*particle_q[i, :2], tip[3]])
        found = find_grasp(above, objects, particle_q, body_q, config)
        if found is not None and abs(found.height - tip[2]) <= within:
            return found
    return None
