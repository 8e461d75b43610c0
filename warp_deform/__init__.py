"""Rearranging deformable objects: simulation, tasks, demonstrations and data.

Importing this package is quick: it registers the Gymnasium ids and loads neither Warp nor torch.
The public names below load their modules on first use.

    import gymnasium
    import warp_deform

    env = gymnasium.make("WarpDeform/CableShape-v1")
    observation, info = env.reset(seed=0)
"""

from __future__ import annotations

import importlib

from .registration import register_environments, register_task

__version__ = "0.1.0"

_HOME = {
    "Episode": "episodes",
    "EpisodeReader": "episodes",
    "EpisodeWriter": "episodes",
    "InputError": "errors",
    "PickPlaceEnv": "env",
    "PickPlaceVectorEnv": "vector_env",
    "PrivilegedStage": "wrappers",
    "TASKS": "tasks.registry",
    "WarpDeformError": "errors",
}

__all__ = ["__version__", *_HOME, "register_task"]


def __getattr__(name: str) -> object:
    """Load a public name's module when the name is first asked for (PEP 562)."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f".{_HOME[name]}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


register_environments()
