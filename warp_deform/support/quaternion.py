"""Unit quaternions in NumPy, in the order x, y, z, w: the one place that knows their formulas.

All functions take stacks: a shape (..., 4) of quaternions with a shape (..., 3) of vectors. Kernels
have Warp's own functions of the same names.

Source: Diebel, "Representing attitude", 2006.
"""

from __future__ import annotations

import numpy as np

__all__ = [
    "quat_by_rotation",
    "quat_from_yaw",
    "quat_inverse",
    "quat_multiply",
    "quat_rotate",
    "quat_rotate_vjp",
    "quat_same_side",
    "quat_tangent",
    "quat_yaw",
]


def quat_from_yaw(yaw: np.ndarray | float) -> np.ndarray:
    """Turns (..., 4) about the vertical axis by `yaw` (...) [rad].

    Examples:
        >>> quat_from_yaw(np.pi).round(3).tolist()
        [0.0, 0.0, 1.0, 0.0]
    """
    sine, cosine = np.sin(np.asarray(yaw) / 2), np.cos(np.asarray(yaw) / 2)
    return np.stack([np.zeros_like(sine), np.zeros_like(sine), sine, cosine], axis=-1)


def quat_yaw(quat_xyzw: np.ndarray) -> np.ndarray:
    """Yaws (...) [rad, -pi to pi] of rotations (..., 4): the last of x-y-z Euler angles.

    Examples:
        >>> float(quat_yaw(quat_from_yaw(0.4)).round(6))
        0.4
    """
    x, y, z, w = np.moveaxis(np.asarray(quat_xyzw, dtype=float), -1, 0)
    yaw: np.ndarray = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return yaw


def quat_rotate(quat_xyzw: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Vectors (..., 3), rotated by quaternions (..., 4)."""
    axis, w = quat_xyzw[..., :3], quat_xyzw[..., 3:]
    twice = 2.0 * np.cross(axis, vector)
    rotated: np.ndarray = vector + w * twice + np.cross(axis, twice)
    return rotated


def quat_rotate_vjp(quat_xyzw: np.ndarray, vector: np.ndarray, g: np.ndarray) -> np.ndarray:
    """Derivatives (..., 4) by the quaternions of g . quat_rotate(quat, vector), g (..., 3).

    The four numbers count as free, as they do in `quat_rotate`'s formula where it is written
    v + 2 w (u x v) + 2 u x (u x v); see `quat_tangent` for what a unit quaternion can follow.
    """
    axis, w = quat_xyzw[..., :3], quat_xyzw[..., 3:]
    by_axis = 2 * w * np.cross(vector, g) + 2 * g * _dot(axis, vector)
    by_axis += 2 * vector * _dot(axis, g) - 4 * axis * _dot(g, vector)
    return np.concatenate([by_axis, 2 * _dot(g, np.cross(axis, vector))], axis=-1)


def quat_tangent(quat_xyzw: np.ndarray, g: np.ndarray) -> np.ndarray:
    """Derivatives g (..., 4) by unit quaternions without their share along these."""
    tangent: np.ndarray = g - quat_xyzw * (quat_xyzw * g).sum(axis=-1, keepdims=True)
    return tangent


def quat_by_rotation(quat_xyzw: np.ndarray) -> np.ndarray:
    """How quaternions (..., 4) change with a rotation vector [rad] from the left: (..., 3, 4)."""
    x, y, z, w = np.moveaxis(quat_xyzw, -1, 0) / 2
    rows = [[w, -z, y, -x], [z, w, -x, -y], [-y, x, w, -z]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quat_multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Hamilton products (..., 4): the rotations `b`, then `a`."""
    xyz = a[..., 3:] * b[..., :3] + b[..., 3:] * a[..., :3] + np.cross(a[..., :3], b[..., :3])
    w = a[..., 3:] * b[..., 3:] - _dot(a[..., :3], b[..., :3])
    return np.concatenate([xyz, w], axis=-1)


def quat_inverse(quat_xyzw: np.ndarray) -> np.ndarray:
    """The inverses (..., 4) of rotations."""
    return quat_xyzw * np.array([-1, -1, -1, 1])


def quat_same_side(quat_xyzw: np.ndarray) -> np.ndarray:
    """A copy of quaternions (n, 4), flipped so that neighbours interpolate the short way round."""
    out = np.array(quat_xyzw, dtype=float)
    for i in range(1, len(out)):
        if out[i] @ out[i - 1] < 0:
            out[i] = -out[i]
    return out


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Products (..., 1) of vectors (..., 3)."""
    return np.einsum("...i,...i->...", a, b)[..., None]
