"""Rearranging deformable objects: simulation, tasks, demonstrations and data.

Importing this package is quick: it registers the Gymnasium ids and loads neither Warp nor torch.
The public names below load their modules on first use.

    import gymnasium
    import warp_deform

    env = gymnasium.make("WarpDeform/CableShape-v2")
    observation, info = env.reset(seed=0)
"""

from __future__ import annotations

from .support.lazy_exports import lazy_exports
from .support.version import __version__
from .tasks.registration import register_environments, register_task

_HOME = {
    "ControlEnv": ".envs.control_env",
    "ControlVectorEnv": ".envs.control_vector_env",
    "Episode": ".episodes",
    "EpisodeReader": ".episodes",
    "EpisodeWriter": ".episodes",
    "InputError": ".errors",
    "PickPlaceEnv": ".envs.env",
    "PickPlaceVectorEnv": ".envs.vector_env",
    "PrivilegedStage": ".envs.wrappers",
    "TASKS": ".tasks.registry",
    "WarpDeformError": ".errors",
}

__all__ = ["__version__", *_HOME, "register_task"]

__getattr__ = lazy_exports(__name__, _HOME)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


register_environments()
