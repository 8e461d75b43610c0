"""Continuous control at 20 Hz: modes of action, limits, episodes, tasks, and search for plans."""

from __future__ import annotations

from ..support.lazy_exports import lazy_exports

_HOME = {
    "CONTROL_MODES": ".modes",
    "CONTROL_TASKS": ".registry",
    "ControlConfig": ".modes",
    "ControlWorlds": ".control_worlds",
    "METHODS": ".plan_search",
    "EpisodeProblem": ".episode_problem",
    "HeldProblem": ".held_problem",
    "Replanner": ".replanner",
    "SwingProblem": ".swing_problem",
    "TensorControlWorlds": ".tensor_worlds",
    "TrajectoryProblem": ".trajectory_problem",
    "optimize": ".plan_search",
}

__all__ = list(_HOME)

__getattr__ = lazy_exports(__name__, _HOME)
