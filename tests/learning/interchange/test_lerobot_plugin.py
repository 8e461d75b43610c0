"""The plugin for LeRobot without LeRobot: what it registers is what the environment gives.

`make test-lerobot` trains and plays with LeRobot itself.
"""

import importlib
import sys
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from types import ModuleType

import gymnasium
import numpy as np
import pytest

from warp_deform.errors import InputError

PLUGIN = Path(__file__).parents[3] / "benchmarks" / "lerobot_env"
NAME = "lerobot_env_warp_deform"


@pytest.fixture
def plugin(monkeypatch):
    """The plugin, imported beside what it needs of LeRobot; registered configurations by name."""
    registered = {}

    class FeatureType(Enum):
        STATE, VISUAL, ENV, ACTION = "STATE", "VISUAL", "ENV", "ACTION"

    @dataclass
    class PolicyFeature:
        type: FeatureType
        shape: tuple

    class EnvConfig:
        @classmethod
        def register_subclass(cls, name):
            return lambda kind: registered.setdefault(name, kind)

        type = "warp_deform"

    stubs = {
        "lerobot": {},
        "lerobot.configs": {},
        "lerobot.configs.types": {"FeatureType": FeatureType, "PolicyFeature": PolicyFeature},
        "lerobot.envs": {},
        "lerobot.envs.configs": {"EnvConfig": EnvConfig},
    }
    for name, contents in stubs.items():
        module = ModuleType(name)
        vars(module).update(contents)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.syspath_prepend(str(PLUGIN))
    module = importlib.import_module(NAME)
    assert registered == {"warp_deform": module.WarpDeformEnv}
    yield module
    del gymnasium.registry[module.ENV_ID]
    for name in [name for name in sys.modules if name.split(".")[0] == NAME]:
        del sys.modules[name]


def flat(observation, prefix=""):
    """Arrays by LeRobot's names: `pixels/top` for the picture `top` among the pixels."""
    found = {}
    for name, value in observation.items():
        if isinstance(value, dict):
            found |= flat(value, f"{prefix}{name}/")
        else:
            found[prefix + name] = np.asarray(value)
    return found


@pytest.mark.parametrize("kind", ["pixels_agent_pos", "environment_state_agent_pos"])
def test_features_are_what_the_environment_gives(plugin, kind):
    config = plugin.WarpDeformEnv(task="block-notarget", obs_type=kind, episode_length=60)
    env = gymnasium.make(config.gym_id, disable_env_checker=True, **config.gym_kwargs)
    observation, _ = env.reset(seed=0)
    shapes = {name: value.shape for name, value in flat(observation).items()}
    features = {name: feature.shape for name, feature in config.features.items()}
    if kind == "environment_state_agent_pos":  # pictures are there for films, not for the policy
        shapes = {name: shape for name, shape in shapes.items() if "pixels" not in name}
    assert features == shapes | {"action": env.action_space.shape}
    assert set(config.features_map) == set(features)
    assert (config.features["agent_pos"].type.value, config.features["action"].type.value) == (
        "STATE",
        "ACTION",
    )
    # what LeRobot's evaluation asks of an environment
    assert env.unwrapped._max_episode_steps == 60
    assert env.unwrapped.metadata["render_fps"] == config.fps == 20
    assert env.unwrapped.task_description.endswith(".")
    assert not hasattr(env, "_has_reset"), "no wrapper hides the task's sentence"


def test_policies_are_led_back_into_the_box_and_numbers_that_are_none_are_refused(plugin):
    config = plugin.WarpDeformEnv(obs_type="environment_state_agent_pos")
    seen = []
    for action in ([3.0, -2.0, 0.5, 0.0, 1.5], [1.0, -1.0, 0.5, 0.0, 1.0]):
        env = gymnasium.make(config.gym_id, disable_env_checker=True, **config.gym_kwargs)
        env.reset(seed=0)
        observation, *_ = env.step(np.array(action))
        seen.append(observation["environment_state"])
    np.testing.assert_array_equal(*seen)
    with pytest.raises(InputError):
        env.step(np.full(5, np.nan))


def test_an_export_has_the_features_by_the_names_that_policies_read(plugin):
    config = plugin.WarpDeformEnv(task="whip-target")
    assert set(config.features_map.values()) == {
        "action",
        "observation.state",
        "observation.images.top",
    }
    export = (Path(__file__).parents[3] / "learning/interchange/lerobot_columns.py").read_text()
    for name in config.features_map.values():
        assert f'"{name}"' in export


@pytest.mark.parametrize(
    "wrong, said",
    [
        ({"obs_type": "rgb"}, "obs_type is one of"),
        ({"control_mode": "joints"}, "control_mode is one of"),
        ({"task": "whisk"}, "whisk"),
    ],
)
def test_what_is_unknown_is_refused_in_one_line(plugin, wrong, said):
    with pytest.raises(InputError, match=said) as refusal:
        plugin.WarpDeformEnv(**wrong)
    assert "\n" not in str(refusal.value)
