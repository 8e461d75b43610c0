"""Problems between the actions of an episode: the operator is asked until they are cleared."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fixtures.franka_arm import Arm, Person, episode
from fixtures.franka_episodes import ACTION, LIMITS

from hardware import MotionError, ReflexError, RobotMode, RobotState, UserStopped
from hardware.arm.panda import HOME_Q
from hardware.episodes.operators import Answer
from warp_deform.errors import InputError

REFLEX = ReflexError("met something", reflexes=("cartesian_reflex",))


class StoppedArm(Arm):
    """Somebody presses the user stop, and releases it after `asked` questions."""

    pressed = False

    def mode(self) -> RobotMode:
        return RobotMode.USER_STOPPED if self.pressed else RobotMode.IDLE

    def state(self) -> RobotState:
        state = super().state()
        return RobotState(
            state.q, state.base_T_tcp, state.force_N, state.gripper_width_m, self.mode()
        )


class Presser(Person):
    """Presses the stop when asked for plan number `at`, and Enter twice before releasing it."""

    def __init__(self, arm: StoppedArm, *, at: int) -> None:
        super().__init__()
        self.arm, self.at = arm, at

    def confirm(self, proposal: object) -> Answer:
        self.arm.pressed |= len(self.proposals) == self.at
        return super().confirm(proposal)

    def go_on(self, problem: Exception) -> bool:
        self.arm.pressed = len(self.problems) < 2
        return super().go_on(problem)


@pytest.mark.parametrize("away", [0.1, 0.0])
def test_a_user_stop_before_a_motion_is_asked_about_until_it_is_released(
    tmp_path: Path, away: float
) -> None:
    """On the way home at the start, and at the first action, which counts as aborted."""
    arm = StoppedArm()
    if away:
        arm.move_joints(np.array(arm.config.q) + away, speed=0.1)
    person = Presser(arm, at=0)
    result, _ = episode(tmp_path / "a", arm, [ACTION] * 2, operator=person, max_actions=2)
    assert result.error is None and len(person.problems) == 3
    assert {type(problem) for problem in person.problems} == {UserStopped}
    assert result.outcomes == (("placed", "placed") if away else ("aborted", "placed"))


def test_a_user_stop_while_choosing_is_asked_about(tmp_path: Path) -> None:
    arm = StoppedArm()
    arm.pressed = True
    person = Presser(arm, at=99)
    result, _ = episode(tmp_path / "a", arm, [ACTION], operator=person, max_actions=1)
    assert result.outcomes == ("placed",) and len(person.problems) == 3


def test_only_recoveries_without_an_operator_count(tmp_path: Path) -> None:
    many = LIMITS.max_recoveries + 2
    result, _ = episode(
        tmp_path / "a",
        Arm(*[REFLEX] * many),
        [ACTION] * many,
        operator=Person(),
        max_actions=many,
    )
    assert result.error is None and result.outcomes == ("aborted",) * many


class RoughArm(Arm):
    """Ends a motion to the home pose off by the next of `misses` [rad] in joint 7."""

    misses: tuple[float, ...] = ()

    def move_joints(self, q: np.ndarray, *, speed: float) -> None:
        super().move_joints(q, speed=speed)
        miss, *self.misses = self.misses or (0.0,)
        self._q[6] += miss


@pytest.mark.parametrize(
    ("misses", "homed"),
    [((0.0,), 1), ((0.004,), 1), ((0.004, 0.004), 1), ((0.02, 0.0), 2), ((0.02, 0.02), 2)],
)
def test_an_arm_that_arrives_roughly_is_sent_home_once_more(
    tmp_path: Path, misses: tuple[float, ...], homed: int
) -> None:
    """What counts as an arrival is at home, even where the second motion misses as well."""
    arm = RoughArm()
    arm.misses = misses
    result, _ = episode(tmp_path / "a", arm, [ACTION], max_actions=1)
    assert result.outcome == "limit" and arm.count("move_joints") == homed


def test_another_home_pose_than_the_calibration_s_is_refused(tmp_path: Path) -> None:
    home = np.add(HOME_Q, [0.0, 0.0, 0.0, 0.1, 0.0, 0.1, 0.0])
    with pytest.raises(InputError, match="home pose of the calibration"):
        episode(tmp_path / "a", Arm(), [ACTION], home_q=home)


def test_who_gives_up_is_not_asked_again(tmp_path: Path) -> None:
    person = Person(clears=False)
    stuck = MotionError("ended elsewhere")
    result, _ = episode(tmp_path / "a", Arm(stuck), [ACTION], operator=person)
    assert result.error is stuck and person.problems == [stuck]
