"""`TensorState`: worlds as tensors, and what is done to them between control steps."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch

__all__: list[str] = []  # `warp_deform.rollout` is the import path of what is here


@dataclass(frozen=True, eq=False)
class TensorState:
    """Worlds (W) at the end of a control step, as tensors of the solver's precision.

    Attributes:
        positions: of the particles (W, P, 3) [m]
        velocities: of the particles (W, P, 3) [m/s]
        body_poses: of the bodies' frames (W, B, 7), position [m] and quat_xyzw
        body_velocities: twists (W, B, 6), linear at the centre of mass [m/s], angular [rad/s]
    """

    positions: torch.Tensor
    velocities: torch.Tensor
    body_poses: torch.Tensor
    body_velocities: torch.Tensor

    def tensors(self) -> tuple[torch.Tensor, ...]:
        """All four, in this order."""
        return tuple(getattr(self, field.name) for field in fields(self))


def put(tensor: torch.Tensor, at: tuple[int, ...], value: torch.Tensor) -> torch.Tensor:
    """The tensor with another value in one place."""
    out = tensor.clone()
    out[at] = value.to(out.dtype)
    return out


def rotated(quat: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
    """Vectors (N, 3), rotated by quaternions (N, 4) x y z w."""
    axis, w = quat[:, :3], quat[:, 3:]
    twice = 2.0 * torch.linalg.cross(axis, vector)
    return vector + w * twice + torch.linalg.cross(axis, twice)
