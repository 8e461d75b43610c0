"""The UR5 of the original benchmark, with a suction tip.

Source: Seita et al., ICRA 2021, section V (arm, home posture and suction gripper of Ravens).
"""

from __future__ import annotations

import numpy as np

from warp_deform.robots.description import ArmConfig, Cylinder, LinkMesh, two_link

__all__ = ["UR5"]

# The lengths that the tip-down posture needs [m]; tests hold them to the URDF.
SHOULDER_HEIGHT = 0.089159
UPPER_ARM = 0.425
FOREARM = 0.39225
LATERAL_OFFSET = 0.10915  # shoulder 0.13585 - elbow 0.1197 + wrist 0.093
WRIST_REACH = 0.09465
FLANGE = 0.0823
# The suction head sits 0.070 m beyond the flange and its tip 0.029 m beyond that.
HEAD_LENGTH = 0.070
TIP_LENGTH = 0.029
TIP_OFFSET = HEAD_LENGTH + TIP_LENGTH


def tip_down_posture(xyz_yaw: np.ndarray) -> np.ndarray:
    """Return the joint positions [rad] (N, 6) of tip-down poses [m, rad] (N, 4).

    The branch of the home posture: shoulder to the left, elbow up, wrist outwards. Beyond reach the
    arm points at the pose, stretched or folded. The last joint is not wrapped.
    """
    x, y, z, yaw = xyz_yaw.T
    radial = np.sqrt(np.maximum(x * x + y * y - LATERAL_OFFSET**2, 0.0))
    turn = np.arctan2(y, x) - np.arctan2(LATERAL_OFFSET, radial)
    height = z + TIP_OFFSET + FLANGE - SHOULDER_HEIGHT
    lift, elbow = two_link(radial - WRIST_REACH, height, UPPER_ARM, FOREARM)
    half_turn = np.full_like(turn, -0.5 * np.pi)
    return np.stack(
        [turn - np.pi, -lift, elbow, lift - elbow - 0.5 * np.pi, half_turn, turn - yaw + half_turn],
        axis=1,
    )


UR5 = ArmConfig(
    name="ur5",
    urdf="ur5/ur5_robot.urdf",
    root="base_link",
    flange="tool0",
    tip_offset=TIP_OFFSET,
    # The benchmark's base faces the table with the shoulder at half a turn.
    mount_yaw=np.pi,
    home_q=(-np.pi, -0.5 * np.pi, 0.5 * np.pi, -0.5 * np.pi, -0.5 * np.pi, 0.0),
    posture=tip_down_posture,
    # From `python benchmarks/kinematics.py --reach-table`; 0.20 m keeps the tool off the shoulder.
    reach_table=(
        (0.00, 0.200, 0.910),
        (0.05, 0.200, 0.904),
        (0.10, 0.200, 0.892),
        (0.15, 0.200, 0.878),
        (0.20, 0.200, 0.862),
        (0.25, 0.200, 0.840),
        (0.30, 0.200, 0.816),
        (0.35, 0.200, 0.786),
        (0.40, 0.200, 0.752),
        (0.45, 0.200, 0.712),
        (0.50, 0.200, 0.664),
        (0.55, 0.200, 0.608),
        (0.60, 0.200, 0.538),
        (0.65, 0.200, 0.448),
        (0.70, 0.200, 0.312),
    ),
    meshes=(
        LinkMesh("base_link", "ur5/meshes/base.stl"),
        LinkMesh("shoulder_link", "ur5/meshes/shoulder.stl"),
        LinkMesh("upper_arm_link", "ur5/meshes/upperarm.stl"),
        LinkMesh("forearm_link", "ur5/meshes/forearm.stl"),
        LinkMesh("wrist_1_link", "ur5/meshes/wrist1.stl"),
        LinkMesh("wrist_2_link", "ur5/meshes/wrist2.stl"),
        LinkMesh("wrist_3_link", "ur5/meshes/wrist3.stl"),
    ),
    cylinders=(
        Cylinder("tip", 0.018, -TIP_OFFSET, -TIP_LENGTH),
        Cylinder("tip", 0.004, -TIP_LENGTH, 0.0),
    ),
)
