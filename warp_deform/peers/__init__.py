"""The peers of the speed benchmark: the same scenes in PyBullet and in Newton's own solvers.

They are cross-checks and yardsticks; no part of the product simulates with them.
"""

from .newton_peer import NEWTON_SOLVERS, NewtonSettings, newton_settings, time_newton
from .pybullet_peer import time_pybullet
from .registry import PEERS, time_peer
from .scene import PEER_SCENES, PeerScene, peer_scene
from .timing import PeerTiming

__all__ = [
    "NEWTON_SOLVERS",
    "PEERS",
    "PEER_SCENES",
    "NewtonSettings",
    "PeerScene",
    "PeerTiming",
    "newton_settings",
    "peer_scene",
    "time_newton",
    "time_peer",
    "time_pybullet",
]
