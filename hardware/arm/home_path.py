"""The way to the home pose from wherever the arm stands: straight up, then through the joints."""

from __future__ import annotations

import numpy as np

from .limits import SafetyLimits

__all__ = ["home_waypoints", "pose_above"]

_STEP = 0.25  # [rad] from one waypoint to the next
_OVERSHOOT = 1e-3  # [m]: the arm may end short, and has to start above the limit next


def pose_above(limits: SafetyLimits, base_T_tcp: np.ndarray) -> np.ndarray | None:
    """Return the pose (4, 4) straight above, from which joints may move; None for one that is one.

    Args:
        limits: below their `contact_height_m` no motion in joint space is let through
        base_T_tcp: where the TCP is measured [m], (4, 4)
    """
    rise = limits.contact_height_m - float(limits.height(base_T_tcp))
    if rise <= 0.0:
        return None
    # A measured rotation is not exact, and a commanded one has to be.
    u, _, v = np.linalg.svd(base_T_tcp[:3, :3])
    above = base_T_tcp.copy()
    above[:3, :3] = u @ v
    above[2, 3] += rise + _OVERSHOOT
    above[3] = 0.0, 0.0, 0.0, 1.0
    return above


def home_waypoints(limits: SafetyLimits, q: np.ndarray, home_q: np.ndarray) -> np.ndarray:
    """Return joint waypoints (N, 7) [rad] from `q` to `home_q`, (7,) each, the last one `home_q`.

    A start within a joint's margin is allowed, waypoints there are not: those are left out.
    """
    count = max(int(np.ceil(np.abs(home_q - q).max() / _STEP)), 1)
    waypoints = q + np.arange(1, count + 1)[:, None] / count * (home_q - q)
    waypoints[-1] = home_q
    outside = (waypoints < limits.q_min) | (waypoints > limits.q_max)
    first_inside = int(np.argmin(outside.any(axis=1)))
    return waypoints[first_inside:]
