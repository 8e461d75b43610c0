"""`--env.type=warp_deform`: what LeRobot asks an environment's configuration for."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import gymnasium
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig

from .environment import ENV_ID
from .features import environment_arguments, feature_shapes, policy_names

__all__ = ["WarpDeformEnv"]


@EnvConfig.register_subclass("warp_deform")
@dataclass
class WarpDeformEnv(EnvConfig):
    """A control environment of warp-deform at 20 Hz.

    Attributes:
        task: a name, "block-notarget" or "whip-target" for instance
        obs_type: "pixels_agent_pos" for pictures and the tip, "environment_state_agent_pos" for
            what the simulator knows in place of pictures
        control_mode: as in the demonstrations; None: what `warp-deform demo --control` takes
        episode_length: control steps; None: the task's
        start: "free" or "held"
    """

    task: str | None = "block-notarget"
    fps: int = 20
    obs_type: str = "pixels_agent_pos"
    control_mode: str | None = None
    episode_length: int | None = None
    start: str = "free"
    robot: str = "ur5"
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        shapes = feature_shapes(self.task or "", self.obs_type, self.control_mode)
        kinds = {"action": FeatureType.ACTION, "agent_pos": FeatureType.STATE}
        kinds |= {"environment_state": FeatureType.ENV}
        self.features = {
            name: PolicyFeature(kinds.get(name, FeatureType.VISUAL), shape)
            for name, shape in shapes.items()
        }
        self.features_map = policy_names(shapes)

    @property
    def package_name(self) -> str:
        """What is imported for the id to be known."""
        return "lerobot_env_warp_deform"

    @property
    def gym_id(self) -> str:
        """The id of every task; `gym_kwargs` say which."""
        return ENV_ID

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments of the environment."""
        return environment_arguments(
            self.task or "", self.obs_type, self.control_mode,
            horizon=self.episode_length, start=self.start, robot=self.robot,
        )  # fmt: skip

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gymnasium.vector.VectorEnv]]:
        """The vector environments that LeRobot evaluates on, from version 0.6 on."""
        kind = gymnasium.vector.AsyncVectorEnv if use_async_envs else gymnasium.vector.SyncVectorEnv

        def one() -> gymnasium.Env:
            return gymnasium.make(ENV_ID, disable_env_checker=True, **self.gym_kwargs)

        reset = gymnasium.vector.AutoresetMode.SAME_STEP
        return {self.type: {0: kind([one] * n_envs, autoreset_mode=reset)}}
