"""Tips under the table, out of reach, told nothing, told too much: what is sent, and its slopes."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from warp_deform.control.limits import TipLimits, soft_clamp, soft_floor
from warp_deform.control.modes import CONTROL_MODES, ControlConfig, TipTargets
from warp_deform.errors import InputError
from warp_deform.robots import robot

UR5 = robot("ur5")
LIMITS = TipLimits(UR5)
START = np.array([[0.5, 0.1, 0.2, 0.3]])


def targets(mode: str, tips: np.ndarray = START, **config: float) -> TipTargets:
    made = TipTargets(mode, ControlConfig(**config), LIMITS, len(tips))
    made.place(range(len(tips)), tips)
    return made


def test_a_soft_floor_is_never_passed_and_leaves_what_is_far_above() -> None:
    values = np.linspace(-0.3, 0.3, 601)
    led = soft_floor(values, 0.01, 0.002)
    assert (led >= 0.01).all()
    assert (np.diff(led) >= 0).all() and (np.diff(led)[300:] > 0).all()
    assert soft_floor(np.array(0.01), 0.01, 0.002) == pytest.approx(0.01 + 0.002 * np.log(2))
    assert np.allclose(led[values > 0.03], values[values > 0.03], atol=2e-7)
    both = soft_clamp(values, -0.1, 0.1, 0.01)
    assert both.min() >= -0.1 and both.max() <= 0.1
    assert np.allclose(both, -both[::-1], atol=1e-5)


@pytest.mark.parametrize("name", ["ur5", "panda"])
def test_whatever_is_asked_for_what_is_sent_is_in_reach_and_above_the_floor(name: str) -> None:
    limits, rng = TipLimits(robot(name)), np.random.default_rng(0)
    asked = rng.uniform([-1.5, -1.5, -0.5, -3], [1.5, 1.5, 1.5, 3], (4000, 4))
    floors = rng.uniform(0.0, 0.05, 4000)
    for wanted in (asked, limits.kept(asked, floors)):
        sent = limits.project(wanted, floors)
        assert (sent[:, 2] >= floors).all() and (sent[:, 2] <= limits.ceiling + 1e-9).all()
        radius = np.hypot(sent[:, 0], sent[:, 1])
        reach = np.array([limits.robot.reach(z) for z in sent[:, 2]])
        assert (radius >= reach[:, 0] - 1e-9).all() and (radius <= reach[:, 1] + 1e-9).all()
        assert (np.abs(np.arctan2(sent[:, 1], sent[:, 0])) <= np.radians(70) + 1e-9).all()
        assert np.array_equal(sent[:, 3], asked[:, 3])
    inside = np.array([0.5, 0.2, 0.15, 1.0])
    assert np.allclose(limits.project(inside, np.array(0.0)), inside, atol=1e-6)
    assert np.array_equal(limits.kept(inside, np.array(0.0)), inside)


def test_torch_gives_the_same_numbers_and_slopes_that_lead_back() -> None:
    rng = np.random.default_rng(1)
    asked = rng.uniform([0.1, -0.9, -0.006, -3], [0.95, 0.9, 0.7, 3], (200, 4))
    floors = np.full(200, 0.005)
    wanted = torch.tensor(LIMITS.kept(asked, floors), requires_grad=True)
    sent = LIMITS.project(wanted, torch.tensor(floors))
    assert np.allclose(sent.detach(), LIMITS.project(wanted.detach().numpy(), floors), atol=1e-12)
    assert torch.autograd.gradcheck(
        lambda w: LIMITS.project(w, torch.tensor(floors[:8])), wanted[:8].detach().requires_grad_()
    )
    (slopes,) = torch.autograd.grad(sent.sum(), wanted)
    assert torch.isfinite(slopes).all() and (slopes.abs().sum(1) > 1e-2).all()
    # also of what is remembered farthest under the table: it can be led up again
    (up,) = torch.autograd.grad(LIMITS.project(wanted, torch.tensor(floors))[:, 2].sum(), wanted)
    assert float(up[:, 2].min()) > 0.02


@pytest.mark.parametrize("mode", [mode for mode in CONTROL_MODES if mode != "tip_position"])
def test_a_tip_that_is_told_nothing_stays_also_at_a_limit(mode: str) -> None:
    made = targets(mode, np.array([[0.5, 0.1, 0.2, 0.3], [0.5, 0.0, 0.0, 0.0]]))
    made.follow([0, 1], np.array([[0, 0, -1.0, *[0] * (made.width - 4), 1]] * 2))
    made.follow([0, 1], np.zeros((2, made.width)))  # a velocity takes a step to fade
    first = made.sent([0, 1])
    for _ in range(40):
        knots = made.follow([0, 1], np.zeros((2, made.width)))
    assert np.array_equal(knots[:, -1], first) and np.array_equal(made.sent([0, 1]), first)


def test_a_tip_pressed_against_the_table_for_long_rises_at_once() -> None:
    made = targets("tip_delta_position")
    down, up = np.array([[0, 0, -1.0, 1]]), np.array([[0, 0, 1.0, 1]])
    for _ in range(60):
        lowest = made.follow([0], down)
    assert 0 < lowest[0, 0, 2] < 0.001
    assert made.follow([0], up)[0, 0, 2] > 0.04


def test_deltas_add_to_the_last_target_and_no_action_is_faster_than_the_limit() -> None:
    made = targets("tip_delta_pose", max_speed=1.0, max_turn=2.0)
    one = made.follow([0], np.array([[0.4, 0, 0, 0.5, 0]]))
    two = made.follow([0], np.array([[0, -0.6, 0, -1, 0]]))
    assert one[0, 0] == pytest.approx([0.52, 0.1, 0.2, 0.35], abs=1e-6)
    assert two[0, 0] == pytest.approx([0.52, 0.07, 0.2, 0.25], abs=1e-6)
    three = made.follow([0], np.array([[-1, -1, 1, 0, 0]]))
    assert np.linalg.norm(three[0, 0, :3] - two[0, 0, :3]) == pytest.approx(0.05, abs=1e-6)
    half = targets("tip_delta_position", rate=40.0, max_speed=1.5)
    assert half.follow([0], np.array([[1.0, 0, 0, 0]]))[0, 0, 0] == pytest.approx(0.5375)


def test_a_velocity_is_reached_without_a_jerk_and_kept() -> None:
    made = targets("tip_velocity")
    first = made.follow([0], np.array([[0.8, 0, 0, 0, 0]]))[0]
    second = made.follow([0], np.array([[0.8, 0, 0, 0, 0]]))[0]
    ways = np.diff(np.concatenate([START, first, second])[:, 0])
    assert first.shape == (4, 4) and (np.diff(ways[:4]) > 0).all()
    assert ways[:4].sum() == pytest.approx(0.02, abs=1e-6), "half of the way at full speed"
    assert ways[4:] == pytest.approx([0.01] * 4, abs=1e-6)


def test_positions_span_the_workspace_and_are_approached_at_the_speed_limit() -> None:
    made = targets("tip_position")
    goal = np.array([[1.0, 0.5, -0.5, 0.0, 0.0]])
    before, ways = START, []
    for _ in range(30):
        now = made.follow([0], goal)[:, 0]
        ways.append(float(np.linalg.norm((now - before)[0, :3])))
        before = now
    assert max(ways) <= 0.05 + 1e-6 and ways[0] == pytest.approx(0.05, abs=1e-6)
    assert before[0] == pytest.approx([0.75, 0.25, 0.1, 0.0], abs=1e-5)


@pytest.mark.parametrize("far", [False, True], ids=["within the limits", "beyond them"])
@pytest.mark.parametrize("mode", ["tip_delta_position", "tip_delta_pose"])
def test_many_steps_at_once_have_the_bits_and_the_slopes_of_one_after_the_other(
    mode: str, far: bool
) -> None:
    rng = np.random.default_rng(2)
    for count, steps in [(1, 20), (3, 7), (8, 25)]:
        tips = START + rng.uniform(-0.05, 0.05, (count, 4))
        one, all_at_once = targets(mode, tips), targets(mode, tips)
        rows = list(range(count))
        actions = (1.0 if far else 0.02) * rng.normal(size=(steps, count, one.width))
        led = np.stack([one.follow(rows, row)[:, -1] for row in actions])
        assert np.array_equal(all_at_once.follow_steps(rows, actions), led)
        assert np.array_equal(all_at_once.asked, one.asked)

        moves = torch.tensor((0.1 if far else 0.001) * actions[..., :3], requires_grad=True)
        moved = torch.nn.functional.pad(moves, (0, 1))
        last, floors = torch.from_numpy(tips), torch.zeros(count, dtype=torch.float64)
        ways = []
        for move in moved:
            last = LIMITS.kept(last + move, floors)
            ways.append(last)
        together = LIMITS.remembered(torch.from_numpy(tips), moved, floors)
        assert torch.equal(together, torch.stack(ways))
        free = torch.from_numpy(tips) + moved.detach().cumsum(0)
        assert torch.allclose(together, free) is not far, "limits are met where they should be"
        back = torch.from_numpy(rng.normal(size=together.shape))
        slopes = [
            torch.autograd.grad(each, moves, back)[0] for each in (together, torch.stack(ways))
        ]
        assert torch.equal(*slopes)


def test_what_is_no_mode_is_named() -> None:
    with pytest.raises(InputError, match="tip_delta_position"):
        targets("pd_joint_pos")
    for wrong in ({"rate": 0.0}, {"max_speed": -1.0}, {"max_turn": np.nan}):
        with pytest.raises(InputError):
            ControlConfig(**wrong)
