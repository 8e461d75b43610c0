"""The control environments of warp-deform for LeRobot: `--env.type=warp_deform`.

Importing this registers the environment with Gymnasium and its configuration with LeRobot.
"""

from __future__ import annotations

import gymnasium

from .config import WarpDeformEnv
from .environment import ENV_ID, PolicyControlEnv

__all__ = ["ENV_ID", "PolicyControlEnv", "WarpDeformEnv"]

# LeRobot reads the task's sentence from the environment itself, so no wrapper goes around it.
gymnasium.register(
    id=ENV_ID, entry_point=PolicyControlEnv, order_enforce=False, disable_env_checker=True
)
