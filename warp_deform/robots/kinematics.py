"""Forward and inverse kinematics of one serial arm, on a pytorch-kinematics chain.

pytorch-kinematics gives the tip pose and the geometric Jacobian; this file adds the damped least
squares iteration. Its linear algebra is written as element-wise operations in a fixed order, so a
pose is solved to the same bits whatever else is in the batch.

Source: Sugihara, "Solvability-Unconcerned Inverse Kinematics by the Levenberg-Marquardt Method",
IEEE Transactions on Robotics 27(5), 2011: damping that shrinks with the squared error.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass

import numpy as np

__all__ = ["SerialArm"]

# An answer counts as reached within these, and the iteration goes on to a tenth of them.
POSITION_TOLERANCE = 1e-4  # [m]
ROTATION_TOLERANCE = 1e-3  # [rad]
# The largest change of a joint in one step [rad]: beyond it the linearisation means nothing.
MAX_STEP = 0.5
# Damping that stays when the error has gone; keeps the 6x6 system definite at a singularity.
DAMPING_FLOOR = 1e-9
# A pose whose error [m + rad] does not shrink to this share in so many steps is given up.
STALL_STEPS = 8
STALL_SHARE = 0.9


@dataclass(frozen=True)
class IKResult:
    """Joint positions for a batch of tip poses, each verified by forward kinematics.

    Attributes:
        q: joint positions [rad], shape (N, dof), float64; the closest found where not reached
        reached: whether the pose is met within 0.1 mm and 1e-3 rad, shape (N,), bool
        position_error: distance of the tip from the pose [m], shape (N,)
        rotation_error: angle between the tip's and the pose's orientation [rad], shape (N,)
    """

    q: np.ndarray
    reached: np.ndarray
    position_error: np.ndarray
    rotation_error: np.ndarray


class SerialArm:
    """The joints of a URDF from a root link to a tip, as a float64 pytorch-kinematics chain.

    Args:
        urdf: the robot description
        root: the link that the chain starts at; placed at `mount_yaw` [rad] about the base's z
        flange: the link that carries the tip
        tip_offset: how far the tip lies along the flange's z axis [m]
    """

    def __init__(
        self, urdf: bytes, *, root: str, flange: str, tip_offset: float, mount_yaw: float
    ) -> None:
        import pytorch_kinematics as pk
        import torch

        text = _kinematic_urdf(
            urdf, root=root, flange=flange, tip_offset=tip_offset, mount_yaw=mount_yaw
        )
        chain = pk.build_serial_chain_from_urdf(text, "tip", "base")
        self._chain = chain.to(dtype=torch.float64)
        low, high = chain.get_joint_limits()
        self.low = np.array(low, dtype=np.float64)
        self.high = np.array(high, dtype=np.float64)

    @property
    def dof(self) -> int:
        """Number of joints."""
        return len(self.low)

    def forward(self, q: np.ndarray) -> np.ndarray:
        """Return base_T_tip, shape (N, 4, 4), of joint positions [rad] of shape (N, dof)."""
        return self._jacobian(q)[1]

    def link_poses(self, q: np.ndarray) -> dict[str, np.ndarray]:
        """Return base_T_link, shape (N, 4, 4), of every link from the base to the tip by name."""
        import torch

        with torch.no_grad():
            frames = self._chain.forward_kinematics(torch.from_numpy(q), end_only=False)
        return {name: frame.get_matrix().numpy() for name, frame in frames.items()}

    def solve(self, base_T_tip: np.ndarray, start: np.ndarray, *, iterations: int) -> IKResult:
        """Return joint positions within the limits whose tip meets base_T_tip.

        Damped least squares from `start` (N, dof); a joint that a step would push through its limit
        is held there and the others take over. Each pose stops as soon as it is met, or after
        `iterations` steps, or when it stalls. What stands in the result is what forward kinematics
        gave last.
        """
        count = len(start)
        q = np.clip(start, self.low, self.high)
        position_error, milestone = np.full(count, np.inf), np.full(count, np.inf)
        rotation_error = np.full(count, np.inf)
        rows = np.arange(count)
        for step in range(iterations + 1):
            if not len(rows):
                break
            jacobian, pose = self._jacobian(q[rows])
            error = _pose_error(base_T_tip[rows], pose)
            position_error[rows] = _norm(error[:3])
            rotation_error[rows] = _norm(error[3:])
            todo = (position_error[rows] > 0.1 * POSITION_TOLERANCE) | (
                rotation_error[rows] > 0.1 * ROTATION_TOLERANCE
            )
            if step % STALL_STEPS == 0:
                size = position_error[rows] + rotation_error[rows]
                todo &= size < STALL_SHARE * milestone[rows]
                milestone[rows] = size
            if step == iterations or not todo.any():
                break
            rows = rows[todo]
            q[rows] = self._step(q[rows], jacobian[todo], error[:, todo])
        reached = (position_error <= POSITION_TOLERANCE) & (rotation_error <= ROTATION_TOLERANCE)
        return IKResult(q, reached, position_error, rotation_error)

    def _jacobian(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the geometric Jacobian (N, 6, dof) and base_T_tip (N, 4, 4)."""
        import torch

        with torch.no_grad():
            jacobian, pose = self._chain.jacobian(torch.from_numpy(q), ret_eef_pose=True)
        return jacobian.numpy(), pose.numpy()

    def _step(self, q: np.ndarray, jacobian: np.ndarray, error: np.ndarray) -> np.ndarray:
        """Return q after one damped least squares step; error is (6, N)."""
        columns = np.ascontiguousarray(jacobian.transpose(2, 1, 0))  # (dof, 6, N)
        step = _damped_least_squares(columns, error)
        blocked = ((q <= self.low) & (step < 0.0)) | ((q >= self.high) & (step > 0.0))
        if blocked.any():
            step = _damped_least_squares(columns * ~blocked.T[:, None], error)
        largest = np.abs(step).max(axis=1, keepdims=True)
        step *= MAX_STEP / np.maximum(largest, MAX_STEP)
        return np.clip(q + step, self.low, self.high)


def _damped_least_squares(columns: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Return J^T (J J^T + mu 1)^-1 e, shape (N, dof), of columns (dof, 6, N) and e (6, N)."""
    damping = 0.5 * _norm(error) ** 2 + DAMPING_FLOOR
    a = columns[0][:, None] * columns[0][None]
    for column in columns[1:]:
        a += column[:, None] * column[None]
    a[range(6), range(6)] += damping
    # Gaussian elimination without pivoting is safe: the matrix is symmetric positive definite.
    x = error.copy()
    for i in range(5):
        factor = a[i + 1 :, i] / a[i, i]
        a[i + 1 :, i + 1 :] -= factor[:, None] * a[i, i + 1 :]
        x[i + 1 :] -= factor * x[i]
    for i in reversed(range(6)):
        x[i] /= a[i, i]
        x[:i] -= a[:i, i] * x[i]
    step = np.empty(columns.shape[::2])
    for j, column in enumerate(columns):
        step[j] = _dot(column, x)
    return step.T


def _pose_error(target: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Return translation [m] and rotation vector [rad] from pose to target, base frame, (6, N)."""
    error = np.empty((6, len(pose)))
    error[:3] = (target[:, :3, 3] - pose[:, :3, 3]).T
    a, b = target[:, :3, None, :3], pose[:, None, :3, :3]
    turn = a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]  # target pose^T
    axis = np.stack(
        [
            turn[:, 2, 1] - turn[:, 1, 2],
            turn[:, 0, 2] - turn[:, 2, 0],
            turn[:, 1, 0] - turn[:, 0, 1],
        ]
    )
    sine = _norm(axis)
    cosine = turn[:, 0, 0] + turn[:, 1, 1] + turn[:, 2, 2] - 1.0
    angle = np.arctan2(sine, cosine)
    error[3:] = axis * (angle / np.maximum(sine, 1e-12))
    # Half a turn has no axis in the skew part; any horizontal one starts the iteration.
    error[3:, (sine < 1e-9) & (cosine < 0.0)] = np.array([[np.pi], [0.0], [0.0]])
    return error


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the sum of products over the first axis, added in its order."""
    total = a[0] * b[0]
    for x, y in zip(a[1:], b[1:], strict=True):
        total = total + x * y
    return total


def _norm(a: np.ndarray) -> np.ndarray:
    """Return the Euclidean norm over the first axis."""
    return np.sqrt(_dot(a, a))


def _kinematic_urdf(
    urdf: bytes, *, root: str, flange: str, tip_offset: float, mount_yaw: float
) -> str:
    """Return a URDF of the joints from root to flange, between a link "base" and a link "tip"."""
    source = ET.fromstring(urdf)
    joint_of_child = {_end(joint, "child"): joint for joint in source.findall("joint")}
    chain = ET.Element("robot", name=source.get("name", "arm"))
    _add_fixed_joint(chain, flange, "tip", xyz=f"0 0 {tip_offset!r}", rpy="0 0 0")
    link = flange
    while link != root:
        joint = joint_of_child[link]
        for part in list(joint):
            if part.tag not in ("parent", "child", "origin", "axis", "limit"):
                joint.remove(part)
        chain.insert(0, joint)
        chain.insert(0, ET.Element("link", name=link))
        link = _end(joint, "parent")
    chain.insert(0, ET.Element("link", name=root))
    _add_fixed_joint(chain, "base", root, xyz="0 0 0", rpy=f"0 0 {mount_yaw!r}")
    chain.extend(ET.Element("link", name=name) for name in ("base", "tip"))
    return ET.tostring(chain, encoding="unicode")


def _end(joint: ET.Element, side: str) -> str:
    """Return the name of the link on one side, "parent" or "child", of a joint."""
    part = joint.find(side)
    return "" if part is None else part.get("link", "")


def _add_fixed_joint(chain: ET.Element, parent: str, child: str, *, xyz: str, rpy: str) -> None:
    """Append a fixed joint from the link `parent` to the link `child`."""
    joint = ET.SubElement(chain, "joint", name=f"{parent}_{child}", type="fixed")
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    ET.SubElement(joint, "origin", xyz=xyz, rpy=rpy)
