"""What a cloned policy is told of a state: where things are, seen from the tip and from each other.

Absolute poses have to be seen everywhere before a network subtracts them well; their differences
are alike all over the table. Of a goal's rows the first two numbers are a place on the table; the
third is an angle or a height, and both readings are given.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["StateSizes", "relative_features"]


@dataclass(frozen=True)
class StateSizes:
    """What an observation "state" consists of.

    Attributes:
        particles: their number P
        bodies: their number B
        goal: shape of what the task aims at; () where it aims at nothing
    """

    particles: int
    bodies: int
    goal: tuple[int, ...]

    @property
    def numbers(self) -> int:
        """Numbers D of an observation."""
        return 4 + 1 + 6 * self.particles + 7 * self.bodies + math.prod(self.goal) + 1

    def split(self, seen: Tensor) -> tuple[Tensor, ...]:
        """Tip (N, 4), holding (N, 1), particles (N, P, 3), bodies (N, B, 7), goal (N, R, C).

        A goal of one row has R = 1. Velocities and the time are left out: demonstrators look at
        neither, and a policy that does finds out at what time they did what.
        """
        most = 3 * self.particles
        sizes = [4, 1, most, most, 7 * self.bodies, math.prod(self.goal), 1]
        tip, holding, beads, _, bodies, goal, _ = seen.split(sizes, dim=-1)
        rows, columns = -1, self.goal[-1] if self.goal else 1
        if math.prod(self.goal) == 0:
            rows, columns = 0, 3
        return (
            tip,
            holding,
            beads.unflatten(-1, (self.particles, 3)),
            bodies.unflatten(-1, (self.bodies, 7)),
            goal.reshape(len(seen), rows, columns),
        )


def relative_features(seen: Tensor, sizes: StateSizes) -> Tensor:
    """Features (N, F) of observations "state" (N, D), see `warp_deform.control.numbers`.

    The tip's place and yaw, particles, bodies and the goal as seen from the tip, bodies' yaws, the
    tip in each body's frame, and, where a goal has as many rows as there are bodies or particles,
    the goal as seen from these.
    """
    tip, holding, beads, bodies, goal = sizes.split(seen)
    place, yaw = tip[:, None, :3], tip[:, 3:]
    away = bodies[..., :3] - place
    turn = _yaw(bodies[..., 3:])
    cos, sin = torch.cos(turn), torch.sin(turn)
    x, y = -away[..., 0], -away[..., 1]
    aim = goal[..., :2] - place[..., :2]
    angle = goal[..., 2:3]
    parts = [
        tip[:, :3], torch.sin(yaw), torch.cos(yaw), holding, beads,
        away, cos, sin, cos * x + sin * y, cos * y - sin * x,
        aim, angle - place[..., 2:], torch.sin(angle), torch.cos(angle),
    ]  # fmt: skip
    if goal.shape[1] == sizes.bodies > 0:
        left = angle[..., 0] - turn
        lever = torch.cos(left) * x - torch.sin(left) * y, torch.sin(left) * x + torch.cos(left) * y
        parts += [goal[..., :2] - bodies[..., :2], torch.cos(left), torch.sin(left)]
        # where the tip has to go so that the body it holds is at its goal
        parts += [aim[..., 0] + lever[0], aim[..., 1] + lever[1]]
    if goal.shape[1] == sizes.particles > 0:
        parts.append(aim - beads[..., :2])
    return torch.cat([part.flatten(1) for part in parts], dim=1)


def _yaw(quaternion: Tensor) -> Tensor:
    """Turn about z [rad] (...) of quaternions x, y, z, w (..., 4)."""
    x, y, z, w = quaternion.unbind(-1)
    return torch.atan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z))
