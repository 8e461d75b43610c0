"""The control environment as LeRobot steps it: what a policy says is led back into the box."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from warp_deform import ControlEnv

__all__ = ["ENV_ID", "PolicyControlEnv"]

ENV_ID = "lerobot_env_warp_deform/Control-v0"
"""One id for all tasks; `task` is an argument."""


class PolicyControlEnv(ControlEnv):
    """`ControlEnv`, whose actions are clipped to -1 to 1 first.

    Policies turn normalised numbers back into actions, and what they say may lie beyond the box.
    `ControlEnv` itself refuses that; LeRobot's evaluation does not clip.
    """

    def step(self, action: ArrayLike) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Lead the tip for one control step; a number that is not finite is refused."""
        return super().step(np.clip(np.asarray(action, dtype=np.float64), -1.0, 1.0))
