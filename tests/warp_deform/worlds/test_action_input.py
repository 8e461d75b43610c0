"""What the environments take for an action, and what they refuse by name."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import RescaleAction
from gymnasium.wrappers.vector import RescaleAction as VectorRescaleAction

from warp_deform import PickPlaceEnv, PickPlaceVectorEnv
from warp_deform.errors import InputError
from warp_deform.support.checked import real_array
from warp_deform.worlds.spaces import action_space, check_action

BLOCK = "block-notarget"
SPACE = action_space()
MIDDLE = (SPACE.low + SPACE.high) / 2
NO_ACTIONS = {
    "complex": MIDDLE + 0j,
    "objects": np.array(MIDDLE, object),
    "truth": np.ones(7, bool),
    "text": np.array([f"{v}" for v in MIDDLE]),
    "words": "pick it up",
    "nothing": None,
    "short": MIDDLE[:6],
    "scalar": 0.5,
    "nested": [list(MIDDLE)],
    "ragged": [[0.5, 0.1], *MIDDLE[2:]],
    "dates": np.zeros(7, "datetime64[s]"),
    "nan": [np.nan, *MIDDLE[1:]],
    "inf": [*MIDDLE[:6], -np.inf],
}


@pytest.fixture(scope="module")
def env() -> PickPlaceEnv:
    made = PickPlaceEnv(BLOCK)
    made.reset(seed=0)
    return made


@pytest.fixture(scope="module")
def envs() -> PickPlaceVectorEnv:
    made = PickPlaceVectorEnv(BLOCK, 2)
    made.reset(seed=0)
    return made


@pytest.mark.parametrize("action", NO_ACTIONS.values(), ids=NO_ACTIONS)
def test_what_is_no_action_is_refused_in_one_line_everywhere(env, envs, action) -> None:
    stacks = isinstance(action, np.ndarray)
    both = np.stack([action, action]) if stacks else [action, action]
    calls = (
        lambda: env.step(action),
        lambda: envs.step(both),
        lambda: env.worlds.step({0: action}),
        lambda: envs.worlds.step({1: action}),
        lambda: env.worlds.lead({0: action}),
    )
    hashes = env.worlds.hash(0), envs.worlds.hash(0), envs.worlds.hash(1)
    for call in calls:
        with pytest.raises(InputError) as caught:
            call()
        assert "\n" not in str(caught.value) and "action" in str(caught.value)
    assert hashes == (env.worlds.hash(0), envs.worlds.hash(0), envs.worlds.hash(1))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_one_rounding_step_beyond_the_limits_is_on_them(dtype, sign: float) -> None:
    limit = SPACE.high if sign > 0 else SPACE.low
    assert np.array_equal(check_action(limit), limit)
    beyond = np.nextafter(limit.astype(dtype), dtype(sign * np.inf))
    taken = check_action(beyond)
    assert SPACE.contains(taken) and np.abs(taken - limit).max() < 1e-6
    # two steps of float32 are too many
    for k in range(7):
        action = MIDDLE.copy()
        action[k] = limit[k] + sign * 3 * np.spacing(
            np.float32(max(abs(SPACE.low[k]), SPACE.high[k]))
        )
        with pytest.raises(InputError, match="allowed are"):
            check_action(action)


def test_what_the_space_holds_is_taken_unchanged() -> None:
    rng = np.random.default_rng(0)
    for action in SPACE.low + (SPACE.high - SPACE.low) * rng.random((200, 7)):
        assert np.array_equal(check_action(action), action)


@pytest.mark.parametrize("value", [-1.0, 1.0])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_saturated_policy_may_be_rescaled(value: float, dtype) -> None:
    env = RescaleAction(gymnasium.make("WarpDeform/BlockNotarget-v2"), dtype(-1), dtype(1))
    env.reset(seed=0)
    assert env.step(np.full(7, value, dtype))[-1]["outcome"]
    envs = VectorRescaleAction(PickPlaceVectorEnv(BLOCK, 2), dtype(-1), dtype(1))
    envs.reset(seed=0)
    assert all(envs.step(np.full((2, 7), value, dtype))[-1]["outcome"])


def test_the_waiting_environment_of_a_vector_may_get_any_number() -> None:
    envs = PickPlaceVectorEnv(BLOCK, 2)
    envs.reset(seed=0)
    envs.ended[:] = True
    envs.step(np.full((2, 7), np.nan))
    assert not envs.ended.any()


def test_a_checked_array_is_a_copy() -> None:
    given = MIDDLE.copy()
    taken = real_array(given, (7,), name="action")
    taken[0] = 9.0
    assert given[0] == MIDDLE[0]
