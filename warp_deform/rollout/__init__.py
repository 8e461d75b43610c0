"""Grip paths in, trajectories out; and derivatives of trajectories.

The public names load on first use, so that reading a task loads neither Warp nor torch.
"""

from __future__ import annotations

from ..support.lazy_exports import lazy_exports

_HOME = {
    "ControlLoop": ".control",
    "DifferentiableRollout": ".differentiable",
    "Frames": ".rollouts",
    "Gradients": ".differentiable",
    "GripPath": ".rollouts",
    "Rollout": ".rollouts",
    "TensorControlLoop": ".tensor_control",
    "TensorRollout": ".autograd",
    "TensorState": ".tensor_state",
    "prepare": ".rollouts",
    "rollout": ".rollouts",
    "rollout_tensors": ".autograd",
    "substep_vjp": ".differentiable",
}

__all__ = list(_HOME)

__getattr__ = lazy_exports(__name__, _HOME)
