"""Who chooses: chance, the true state, a planner, a person."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
from fixtures.franka_arm import Arm
from fixtures.franka_episodes import (
    CALIBRATION,
    GOAL,
    LIMITS,
    SMALL,
    TASK,
    TWIN,
    chain,
    drawn_camera,
    recorder,
)

from hardware.arm.pick_place import PickPlaceAction, PickPlaceConfig, refusal
from hardware.arm.safe_robot import SafeRobot
from hardware.choosers.finger_clearance import has_finger_clearance
from hardware.choosers.human import HumanChooser
from hardware.choosers.planner import PlannerChooser, PlannerConfig, SeenChain
from hardware.choosers.simple import RandomChooser, ScriptedChooser, still_chain, to_action
from hardware.episodes.episode import EpisodeConfig, Observation, run_episode
from hardware.recordings.recording import Recording
from hardware.recordings.replay import replay_recording
from hardware.twin.camera import SimCamera
from hardware.twin.robot import SimRobot
from hardware.twin.twin import CableTwin
from warp_deform.tasks.task import Layout


def test_a_persons_points_are_grasped_across_the_cable(tmp_path: Path) -> None:
    shown: list[np.ndarray] = []

    def points(picture: np.ndarray, view: object) -> object:
        shown.append(picture)
        return tuple(map(tuple, TWIN.view.base_to_pixel(np.array([[0.45, 0.1], [0.5, 0.2]]))))

    chooser = HumanChooser(points)
    with recorder(tmp_path / "a") as made, drawn_camera(lambda: 0.45) as camera:
        result = run_episode(
            SafeRobot(Arm(), LIMITS),
            camera,
            CALIBRATION,
            chooser,
            recorder=made,
            goal=GOAL,
            config=EpisodeConfig(max_actions=1),
        )
    assert result.outcomes == ("placed",) and shown[0].shape == (960, 480, 3)
    x, y, yaw, *place = Recording.read(tmp_path / "a").actions[0]["action"]
    np.testing.assert_allclose(
        [x, y, abs(yaw), *place[:2]], [0.45, 0.1, np.pi / 2, 0.5, 0.2], atol=0.02
    )


def test_random_actions_pick_the_cable_and_stay_inside() -> None:
    mask = TASK.mask(chain(0.45))
    chooser = RandomChooser(np.random.default_rng(0))
    seen = Observation(0, np.zeros((320, 160, 3), np.uint8), mask, None, None)
    robot = SafeRobot(Arm(), LIMITS)
    allowed = 0
    for _ in range(20):
        action = chooser.choose(seen)
        assert action is not None and abs(action.pick_xy[0] - 0.45) < 0.005
        allowed += refusal(robot, action, PickPlaceConfig()) is None
    assert allowed > 10
    empty = Observation(0, seen.view, np.zeros_like(mask), None, None)
    assert chooser.choose(empty) is None


def test_the_scripted_and_the_planned_action_approach_the_goal(tmp_path: Path) -> None:
    targets = chain(0.52)[:, :2]
    goal = TASK.mask(targets)
    twin = CableTwin()
    planner = PlannerChooser(config=PlannerConfig(budget=8))
    for chooser in (ScriptedChooser(twin.look, targets), planner):
        twin.lay(chain(0.45))
        robot = SafeRobot(SimRobot(twin), LIMITS)
        folder = tmp_path / chooser.name
        with recorder(folder, goal=goal) as made, SimCamera(twin.look, config=SMALL) as camera:
            result = run_episode(
                robot,
                camera,
                CALIBRATION,
                chooser,
                recorder=made,
                goal=goal,
                config=EpisodeConfig(max_actions=1),
            )
        assert result.outcomes == ("placed",)
        after = twin.look().beads[:, :2]
        ways = [np.linalg.norm(after - targets[::way], axis=1).mean() for way in (1, -1)]
        assert min(ways) < 0.9 * 0.07
        assert replay_recording(folder).mismatches == 0


def test_the_scripted_chooser_takes_the_demonstrators_beads_and_others_where_those_fail() -> None:
    beads = chain(0.45)
    beads[:, 2] -= beads[:, 2].min()
    targets = beads[:, :2] + 0.05 * np.sin(np.linspace(0.3, 2.0, 90))[:, None] * [1.0, 0.0]
    chooser = ScriptedChooser(lambda: SimpleNamespace(beads=beads), targets)
    mask = TASK.mask(beads)
    still = Observation(0, np.zeros((320, 160, 3), np.uint8), mask, None, None, ())
    asked = [chooser.choose(still) for _ in range(8)]
    layout = Layout(np.zeros((0, 3)), np.zeros((0, 7)), targets)
    moves = TASK.demonstrated_moves(layout, still_chain(beads))
    assert asked[:5] == [to_action(move) for move in moves]
    assert None not in asked and len({each.pick_xy for each in asked}) == 8


def test_an_environments_action_loses_its_lift() -> None:
    action = to_action(np.array([0.4, 0.1, 0.2, 0.5, -0.1, 0.3, 0.05]))
    assert action == PickPlaceAction((0.4, 0.1), 0.2, (0.5, -0.1), 0.3)


def test_a_planner_prefers_a_straight_chain_beside_its_goal_to_a_kinked_one_on_it() -> None:
    task = SeenChain(GOAL)
    targets = chain(0.50)[:, :2]
    layout = Layout(chain(0.50), np.zeros((0, 7)), targets)
    beside, kinked = chain(0.52), chain(0.50)
    kinked[45:60, 1] = kinked[45, 1] - np.arange(15) * 5e-3  # back
    kinked[60:, 1] -= 30 * 5e-3  # and on from there
    distances = [np.linalg.norm(q[:, :2] - targets, axis=1).mean() for q in (beside, kinked)]
    beside += [np.diff(distances)[0], 0.0, 0.0]
    values = [task.state_value(layout, still_chain(q)) for q in (beside, kinked)]
    scores = [task.score(layout, still_chain(q)) for q in (beside, kinked)]
    assert scores[0] < scores[1], "the kinked one lies half on the goal"
    assert values[0] - scores[0] > values[1] - scores[1] + 0.1


def test_fingers_need_room_beside_the_strand() -> None:
    lone = TASK.mask(chain(0.45))

    def room(mask: np.ndarray, yaw: float) -> bool:
        action = PickPlaceAction((0.45, 0.0), yaw, (0.5, 0.0), yaw)
        return has_finger_clearance(mask, action, view=TWIN.view)

    assert room(lone, np.pi / 2) and not room(lone, 0.0), "along the strand both fingers meet it"
    verdicts = {gap: room(lone | TASK.mask(chain(0.45 + gap)), np.pi / 2) for gap in (0.022, 0.032)}
    assert verdicts == {0.022: False, 0.032: True}
