"""`Follow`: the same action after another one, picking the same thing wherever that leaves it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ..robots.primitive import find_grasp
from ..tasks.task import Action, Snapshot, Task

__all__ = ["Follow"]


@dataclass(frozen=True, eq=False)
class Follow:
    """What an action picks, and where the tip meets it.

    Attributes:
        like: the action (7,), whose pick x, y stand for what is taken
        offset: (3,) [m], of the tip from the particle, or in the frame of the body
    """

    like: Action
    offset: np.ndarray
    particle: int | None = None
    body: int | None = None

    @staticmethod
    def of(task: Task, snapshot: Snapshot, action: Action) -> Follow | None:
        """What the action picks in a state; None when that is nothing."""
        s = snapshot
        grasp = find_grasp(action[:3], s.objects, s.particle_q, s.body_q, task.primitive)
        if grasp is None:
            return None
        tip = np.array([action[0], action[1], grasp.height])
        if grasp.particle is not None:
            return Follow(action, tip - s.particle_q[grasp.particle], particle=grasp.particle)
        assert grasp.body is not None
        pose = s.body_q[grasp.body].astype(float)
        offset = Rotation.from_quat(pose[3:]).inv().apply(tip - pose[:3])
        return Follow(action, offset, body=grasp.body)

    def action(self, snapshot: Snapshot) -> Action:
        """The action in another state."""
        moved = self.like.copy()
        if self.particle is not None:
            moved[:2] = snapshot.particle_q[self.particle, :2] + self.offset[:2]
        else:
            pose = snapshot.body_q[self.body].astype(float)
            moved[:2] = pose[:2] + Rotation.from_quat(pose[3:]).apply(self.offset)[:2]
        return moved

    def add(
        self,
        by_pick: np.ndarray,
        by_turn: float,
        snapshot: Snapshot,
        particles: np.ndarray,
        bodies: np.ndarray,
    ) -> None:
        """Add to derivatives (P, 3), (B, 7) by the state it is read of.

        Args:
            by_pick: (2,), derivatives by pick x, y
            by_turn: by a turn about the vertical of what is held in the tip, which is how a body
                lies there
        """
        if self.particle is not None:
            particles[self.particle, :2] += by_pick
            return
        bodies[self.body, :2] += by_pick
        turn = snapshot.body_q[self.body, 3:].astype(float)
        v, w, g, r = turn[:3], turn[3], np.append(by_pick, 0.0), self.offset
        # of g . (r + 2 w v x r + 2 v x (v x r)), where v x (v x r) = v (v . r) - r (v . v)
        by_v = 2 * w * np.cross(r, g) + 2 * (g * (v @ r) + r * (v @ g) - 2 * v * (r @ g))
        bodies[self.body, 3:] += [*by_v, 2 * np.cross(v, r) @ g]
        # a turn by d about the vertical changes the quaternion by d / 2 (0, 0, 1, 0) * turn
        bodies[self.body, 3:] += 2 * by_turn * np.array([-v[1], v[0], w, -v[2]])
