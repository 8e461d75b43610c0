"""What a motion command may ask for: velocity, acceleration and jerk, and the names of excesses.

The robot takes the derivatives of what it is commanded by backward differences over its period and
aborts a motion whose derivatives exceed these limits, by every name that applies. A velocity
discontinuity is too much acceleration, an acceleration discontinuity too much jerk.

Source: Franka Control Interface documentation, "Robot and interface specifications", limits of the
Panda, and libfranka's `rate_limiting.h`, whose client side stays 0.001 below them; of translation
and rotation the lengths of the vectors are limited, as there.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..arm.panda import DDQ_MAX, DQ_MAX, TAU_MAX

__all__ = [
    "DT",
    "Check",
    "elbow_excess",
    "excess_at_end",
    "joint_excess",
    "torque_excess",
    "twist_excess",
]

DT = 1e-3  # [s], the interface's period
DDDQ_MAX = np.array([7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0])  # [rad/s^3]
JOINT_MAX = (DQ_MAX, DDQ_MAX, DDDQ_MAX)
# Translation [m/s], [m/s^2], [m/s^3] and rotation [rad/s], [rad/s^2], [rad/s^3].
TWIST_MAX = ((1.7, 2.5), (13.0, 25.0), (6500.0, 12500.0))
ELBOW_MAX = tuple(np.array([limit]) for limit in (2.175, 10.0, 5000.0))
TAU_RATE_MAX = 1000.0  # [N m/s]
# Doubles of some radians, subtracted and divided by DT three times, are off by so much; libfranka
# stays farther away from its limits.
ROUNDING = 1e-5
_TAU_GREATEST = TAU_MAX + ROUNDING
_NAMES = ("velocity_limits_violation", "velocity_discontinuity", "acceleration_discontinuity")

# Says by which names a velocity, its acceleration and its jerk are too much.
Check = Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[str, ...]]


def joint_excess(
    dq: np.ndarray, ddq: np.ndarray, dddq: np.ndarray, *, by: str = "joint_motion_generator"
) -> tuple[str, ...]:
    """Return the names by which joint velocities, accelerations and jerks (7,) are too much.

    Args:
        dq: velocities [rad/s]; here and below NaN is too much
        ddq: accelerations [rad/s^2]
        dddq: jerks [rad/s^3]
        by: what the names begin with
    """
    return tuple(
        f"{by}_{name}"
        for name, value, limit in zip(_NAMES, (dq, ddq, dddq), JOINT_MAX, strict=True)
        if not (np.abs(value) <= limit + ROUNDING).all()
    )


def twist_excess(twist: np.ndarray, rate: np.ndarray, jerk: np.ndarray) -> tuple[str, ...]:
    """Return the names by which an end effector's twist (6,) and its derivatives are too much."""
    return tuple(
        f"cartesian_motion_generator_{name}"
        for name, value, limit in zip(_NAMES, (twist, rate, jerk), TWIST_MAX, strict=True)
        if not _within(value, *limit)
    )


def _within(twist: np.ndarray, translation: float, rotation: float) -> bool:
    """Return whether the two halves of a twist are as long as allowed; not where one is NaN."""
    x, y, z, a, b, c = twist.tolist()
    longest, fastest = translation + ROUNDING, rotation + ROUNDING
    within = x * x + y * y + z * z <= longest * longest
    return bool(within and a * a + b * b + c * c <= fastest * fastest)


def elbow_excess(velocity: np.ndarray, rate: np.ndarray, jerk: np.ndarray) -> tuple[str, ...]:
    """Return the one name by which the elbow's velocity (1,) or a derivative is too much."""
    values = zip((velocity, rate, jerk), ELBOW_MAX, strict=True)
    within = all((np.abs(value) <= limit + ROUNDING).all() for value, limit in values)
    return () if within else ("cartesian_motion_generator_elbow_limit_violation",)


def torque_excess(tau: np.ndarray, before: np.ndarray) -> tuple[str, ...]:
    """Return the names by which commanded torques [N m] (7,) are too much, or change too fast."""
    if not (np.abs(tau) <= _TAU_GREATEST).all():
        return ("tau_J_range_violation",)
    if not (np.abs(tau - before) <= (TAU_RATE_MAX + ROUNDING) * DT).all():
        return ("controller_torque_discontinuity",)
    return ()


def excess_at_end(velocity: np.ndarray, acceleration: np.ndarray, check: Check) -> tuple[str, ...]:
    """Return the names by which standing still after this sample is too much for the arm.

    A motion that is said to be finished commands no velocity and no acceleration from then on; what
    still moved faster than the limits let it stop within a sample was no end.

    Args:
        velocity: of the last sample
        acceleration: of the last sample
        check: of the limits
    """
    still = np.zeros_like(velocity)
    braking = -velocity / DT
    stopping = check(still, braking, (braking - acceleration) / DT)
    stopped = check(still, still, -braking / DT)
    return tuple(dict.fromkeys(stopping + stopped))
