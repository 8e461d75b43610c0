"""The Franka Panda with its parallel hand: the arm of the physical set-up."""

from __future__ import annotations

import numpy as np

from warp_deform.robots.description import ArmConfig, LinkMesh, two_link

__all__ = ["PANDA"]

# The lengths that the tip-down posture needs [m]; tests hold them to the URDF.
SHOULDER_HEIGHT = 0.333
UPPER_ARM = 0.316
FOREARM = 0.384
ELBOW_OFFSET = 0.0825
WRIST_OFFSET = 0.088
FLANGE = 0.107
TCP = 0.1034
FINGER = "panda/meshes/finger.stl"
FINGER_JOINT = 0.0584
FINGER_OPENING = 0.01  # of each finger, as drawn


def tip_down_posture(xyz_yaw: np.ndarray) -> np.ndarray:
    """Return the joint positions [rad] (N, 7) of tip-down poses [m, rad] (N, 4).

    The arm stays in the vertical plane through its base axis (q3 = q5 = 0), elbow up. Beyond reach
    it points at the pose, stretched or folded. The last joint is neither wrapped nor limited: it
    turns 5.8 rad, so for 0.5 rad of yaw the elbow has to leave the plane, which the solver does.
    """
    x, y, z, yaw = xyz_yaw.T
    turn = np.arctan2(y, x)
    radius = np.sqrt(x * x + y * y) - WRIST_OFFSET
    height = z + TCP + FLANGE - SHOULDER_HEIGHT
    upper, lower = np.hypot(UPPER_ARM, ELBOW_OFFSET), np.hypot(FOREARM, ELBOW_OFFSET)
    lift, elbow = two_link(radius, height, upper, lower)
    # From the lines between joints to the joints' zeros; Franka counts from the vertical.
    q2 = 0.5 * np.pi - lift - np.arctan2(ELBOW_OFFSET, UPPER_ARM)
    q6 = 0.5 * np.pi - lift + elbow + np.arctan2(ELBOW_OFFSET, FOREARM)
    zero = np.zeros_like(turn)
    return np.stack([turn, q2, zero, q2 - q6, zero, q6, 0.25 * np.pi + turn - yaw], axis=1)


PANDA = ArmConfig(
    name="panda",
    urdf="panda/panda.urdf",
    root="panda_link0",
    flange="panda_hand",
    tip_offset=TCP,
    mount_yaw=0.0,
    home_q=(0.0, -0.25 * np.pi, 0.0, -0.75 * np.pi, 0.0, 0.5 * np.pi, 0.25 * np.pi),
    posture=tip_down_posture,
    # From `python benchmarks/kinematics.py --reach-table`; 0.20 m keeps the tool off the shoulder.
    reach_table=(
        (0.00, 0.252, 0.790),
        (0.05, 0.280, 0.796),
        (0.10, 0.292, 0.800),
        (0.15, 0.292, 0.800),
        (0.20, 0.278, 0.796),
        (0.25, 0.248, 0.788),
        (0.30, 0.200, 0.778),
        (0.35, 0.200, 0.764),
        (0.40, 0.200, 0.744),
        (0.45, 0.200, 0.722),
        (0.50, 0.200, 0.694),
        (0.55, 0.200, 0.660),
        (0.60, 0.200, 0.620),
        (0.65, 0.200, 0.572),
        (0.70, 0.200, 0.510),
    ),
    meshes=(
        *(LinkMesh(f"panda_link{i}", f"panda/meshes/link{i}.stl") for i in range(8)),
        LinkMesh("panda_hand", "panda/meshes/hand.stl"),
        LinkMesh("panda_hand", FINGER, (0.0, FINGER_OPENING, FINGER_JOINT)),
        LinkMesh("panda_hand", FINGER, (0.0, -FINGER_OPENING, FINGER_JOINT), np.pi),
    ),
)
