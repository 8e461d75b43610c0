"""The peers of the speed benchmark: the same scenes in MuJoCo, PyBullet and Newton's own solvers.

They are cross-checks and yardsticks; no part of the product simulates with them.
"""

from .mujoco_peer import MujocoSettings, mujoco_settings, time_mujoco
from .mujoco_soft import MujocoSoftSettings, time_mujoco_soft
from .newton_peer import NEWTON_SOLVERS, NewtonSettings, newton_settings, time_newton
from .newton_soft import NewtonSoftSettings, time_newton_soft
from .pybullet_peer import PyBulletSettings, time_pybullet
from .pybullet_soft import PyBulletSoftSettings, time_pybullet_soft
from .registry import PEERS, SOFT_PEERS, check_peer, time_peer
from .scene import PEER_SCENES, PeerScene, peer_scene
from .soft_scene import SOFT_SCENES, SoftScene, soft_scene
from .timing import PeerTiming

__all__ = [
    "NEWTON_SOLVERS",
    "PEERS",
    "PEER_SCENES",
    "SOFT_PEERS",
    "SOFT_SCENES",
    "MujocoSettings",
    "MujocoSoftSettings",
    "NewtonSettings",
    "NewtonSoftSettings",
    "PeerScene",
    "PeerTiming",
    "PyBulletSettings",
    "PyBulletSoftSettings",
    "SoftScene",
    "check_peer",
    "mujoco_settings",
    "newton_settings",
    "peer_scene",
    "soft_scene",
    "time_mujoco",
    "time_mujoco_soft",
    "time_newton",
    "time_newton_soft",
    "time_peer",
    "time_pybullet",
    "time_pybullet_soft",
]
