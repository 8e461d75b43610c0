"""A frame of a Newton simulation recorded once and replayed, so that Python costs nothing."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import newton
import warp as wp

__all__ = ["record_frame"]

_MOVING = ("particle_q", "particle_qd", "body_q", "body_qd")


def record_frame(
    simulate: Callable[[], None], solver: newton.solvers.SolverBase, state: newton.State
) -> Any:
    """The graph of `simulate`, for `wp.capture_launch`.

    A frame is run before for its allocations; `state` and `solver` are then put back.
    """
    arrays = {name: getattr(state, name) for name in _MOVING}
    start = {name: wp.clone(array) for name, array in arrays.items() if array is not None}
    with wp.ScopedDevice("cpu"):
        simulate()
        with wp.ScopedCapture(device="cpu") as capture:
            simulate()
    solver.reset(state)
    for name, array in start.items():
        wp.copy(getattr(state, name), array)
    return capture.graph
