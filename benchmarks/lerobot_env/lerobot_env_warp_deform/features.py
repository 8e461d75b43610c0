"""What LeRobot is told of a task: shapes, names, and the arguments of its environment."""

from __future__ import annotations

from typing import Any

from warp_deform import ControlEnv
from warp_deform.control import CONTROL_MODES
from warp_deform.control.registry import control_task
from warp_deform.control.tip_demonstrator import usual_mode
from warp_deform.errors import InputError
from warp_deform.rendering.pixels import SHAPE

__all__ = ["OBSERVATIONS", "environment_arguments", "feature_shapes", "policy_names"]

OBSERVATIONS = {"pixels_agent_pos": "rgb", "environment_state_agent_pos": "rgb+state"}
"""`obs_mode` of the environment, by LeRobot's `obs_type`."""
_AGENT = 5
"""Numbers of `agent_pos`: the tip's x, y, z, yaw, and whether it holds something."""


def environment_arguments(
    task: str,
    obs_type: str,
    control_mode: str | None,
    *,
    horizon: int | None = None,
    start: str = "free",
    robot: str = "ur5",
) -> dict[str, Any]:
    """Arguments of `ControlEnv`.

    Args:
        control_mode: None for the one in which `warp-deform demo --control` leads the task

    Raises:
        InputError: there is no such task or `obs_type`.
    """
    if obs_type not in OBSERVATIONS:
        raise InputError(f"obs_type is one of {', '.join(OBSERVATIONS)}, not {obs_type!r}")
    return {
        "task": task,
        "obs_mode": OBSERVATIONS[obs_type],
        "control_mode": control_mode or usual_mode(control_task(task)),
        "horizon": horizon,
        "start": start,
        "robot": robot,
        "render_mode": "rgb_array",
    }


def feature_shapes(
    task: str, obs_type: str, control_mode: str | None
) -> dict[str, tuple[int, ...]]:
    """Shapes of the action and of what is observed, by the environment's names.

    Raises:
        InputError: see `environment_arguments`.
    """
    arguments = environment_arguments(task, obs_type, control_mode)
    mode = arguments["control_mode"]
    if mode not in CONTROL_MODES:
        raise InputError(f"control_mode is one of {', '.join(CONTROL_MODES)}, not {mode!r}")
    shapes: dict[str, tuple[int, ...]] = {
        "action": (len(CONTROL_MODES[mode]),),
        "agent_pos": (_AGENT,),
    }
    if obs_type == "environment_state_agent_pos":
        numbers = ControlEnv(task, control_mode=mode).observation_space.shape
        assert numbers is not None, "the observation `state` is a box"
        return shapes | {"environment_state": numbers}
    shapes["pixels/top"] = (*SHAPE, 3)
    if control_task(task).goal_conditioned:
        shapes["pixels/goal"] = (*SHAPE, 3)
    return shapes


def policy_names(shapes: dict[str, tuple[int, ...]]) -> dict[str, str]:
    """What LeRobot's data sets and policies call these features."""
    known = {
        "action": "action",
        "agent_pos": "observation.state",
        "environment_state": "observation.environment_state",
        "pixels/top": "observation.images.top",
        "pixels/goal": "observation.images.goal",
    }
    return {name: known[name] for name in shapes}
