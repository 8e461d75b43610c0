"""An episode in a closed loop: what it does, records and survives; the whole chain, emulated."""

from __future__ import annotations

import functools
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fixtures.franka_arm import FAR, Arm, Person, episode
from fixtures.franka_episodes import (
    ACTION,
    CALIBRATION,
    GOAL,
    LIMITS,
    SMALL,
    TASK,
    TWIN,
    Listed,
    chain,
    drawn_camera,
    frame_of,
    recorder,
)
from fixtures.places import ROOT, SHARED

from hardware import (
    ConnectionLost,
    GraspError,
    MotionError,
    ReflexError,
    SafetyViolation,
    UserStopped,
)
from hardware.arm.safe_robot import SafeRobot
from hardware.choosers.human import TerminalOperator
from hardware.choosers.simple import PolicyChooser
from hardware.emulator import EmulatorProcess
from hardware.episodes.episode import EpisodeConfig, run_episode
from hardware.episodes.operators import Answer, Proposal
from hardware.recordings.recording import Recording
from hardware.recordings.replay import replay_recording
from hardware.recordings.scoring import StartAtGoal, score_recording
from hardware.rig.config import RigConfig
from hardware.twin.camera import SimCamera, sim_calibration
from hardware.twin.twin import CableTwin, TwinConfig
from hardware.vision.segmentation import segment_cable
from warp_deform.command.main import main as command
from warp_deform.errors import InputError, WarpDeformError
from warp_deform.tasks.metrics import mask_iou
from warp_deform.xpbd.guards import PhysicsError, Problem, ProblemKind

POLICY = ROOT / "benchmarks/results/learning/policies/cable-mask-goal-goal-split-500"


def test_an_episode_ends_at_success(tmp_path: Path) -> None:
    places = iter([0.40, 0.45, 0.50])
    result, chooser = episode(tmp_path / "a", Arm(), [ACTION] * 5, where=lambda: next(places))
    assert result.outcome == "success" and result.error is None
    assert result.score is not None and result.score.actions_to_success == 2
    assert result.score.iou[0] < 0.01 and result.score.iou[2] > 0.5
    assert [seen.index for seen in chooser.seen] == [0, 1]
    assert [seen.last for seen in chooser.seen] == [None, "placed"]
    again = score_recording(tmp_path / "a")
    assert again.iou == result.score.iou and again.warnings == ()
    found = replay_recording(tmp_path / "a")
    assert (found.mismatches, found.actions, found.outcome) == (0, 2, "success")
    overlays = sorted(path.name for path in (tmp_path / "a" / "frames").glob("*_overlay.png"))
    assert len(overlays) == 3


def test_a_start_at_the_goal_is_tossed_again(tmp_path: Path) -> None:
    places = {"x": 0.50}
    tosses: list[int] = []

    def toss(again: int) -> None:
        tosses.append(again)
        places["x"] = 0.50 if again < 3 else 0.45

    said: list[str] = []
    with recorder(tmp_path / "a") as made, drawn_camera(lambda: places["x"]) as camera:
        result = run_episode(
            SafeRobot(Arm(), LIMITS),
            camera,
            CALIBRATION,
            Listed([ACTION]),
            recorder=made,
            goal=GOAL,
            config=EpisodeConfig(max_actions=1),
            toss=toss,
            say=said.append,
        )
    assert tosses == [1, 2, 3] and "no success" in said[0]
    assert result.outcome == "limit" and result.score is not None and not result.score.success
    assert len(Recording.read(tmp_path / "a").observations) == 2


def test_a_start_at_the_goal_is_for_the_operator_to_clear(tmp_path: Path) -> None:
    places = iter([0.50, 0.50, 0.45, 0.50])
    person = Person()
    result, _ = episode(
        tmp_path / "a", Arm(), [ACTION], where=lambda: next(places), operator=person
    )
    assert [type(problem) for problem in person.problems] == [StartAtGoal] * 2
    assert result.outcome == "success" and len(result.outcomes) == 1
    gives_up = Person(clears=False)
    result, chooser = episode(
        tmp_path / "b", Arm(), [ACTION], where=lambda: 0.50, operator=gives_up
    )
    assert isinstance(result.error, StartAtGoal) and chooser.seen == []
    assert result.score is not None and result.score.at_start and not result.score.success


def test_an_episode_ends_at_its_limit_and_where_nothing_is_to_do(tmp_path: Path) -> None:
    limit, _ = episode(tmp_path / "a", Arm(), [ACTION] * 5, max_actions=2)
    assert limit.outcome == "limit" and len(limit.outcomes) == 2
    idle, _ = episode(tmp_path / "b", Arm(), [ACTION, None])
    assert idle.outcome == "stopped" and len(idle.outcomes) == 1
    assert len(Recording.read(tmp_path / "b").observations) == 2


def test_a_missed_grasp_goes_on(tmp_path: Path) -> None:
    result, _ = episode(tmp_path / "a", Arm(width=0.0), [ACTION] * 3, max_actions=2)
    assert result.outcomes == ("missed_grasp", "missed_grasp") and result.error is None


def test_a_refused_action_moves_nothing_and_another_is_asked_for(tmp_path: Path) -> None:
    arm = Arm()
    result, chooser = episode(tmp_path / "a", arm, [FAR, ACTION], max_actions=1)
    assert result.outcomes == ("placed",)
    assert [len(seen.refused) for seen in chooser.seen] == [0, 1]
    arm = Arm()
    result, _ = episode(tmp_path / "b", arm, [FAR] * 50)
    assert isinstance(result.error, SafetyViolation) and arm.count("move_linear") == 0
    assert result.outcome.startswith("error: SafetyViolation: workspace")
    assert Recording.read(tmp_path / "b").meta["outcome"] == result.outcome


def test_a_reflex_is_recovered_from_as_often_as_the_limits_allow(tmp_path: Path) -> None:
    reflex = ReflexError("met something", reflexes=("cartesian_reflex",))
    arm = Arm(reflex)
    result, _ = episode(tmp_path / "a", arm, [ACTION] * 2, max_actions=2)
    assert result.outcomes == ("aborted", "placed") and result.error is None
    row = Recording.read(tmp_path / "a").actions[0]
    assert row["outcome"] == "aborted" and row["place_xyz"] is None and row["action"][6] == 0.05
    last = [command.name for command in arm.commands].index("recover", 1)
    assert [command.name for command in arm.commands[last : last + 2]] == [
        "recover",
        "open_gripper",
    ]
    result, _ = episode(tmp_path / "b", Arm(*[reflex] * 5), [ACTION] * 5)
    assert isinstance(result.error, SafetyViolation) and "max_recoveries" in str(result.error)
    assert result.outcomes == ("aborted", "aborted")


@pytest.mark.parametrize(
    "error",
    [
        UserStopped("the user stop is pressed"),
        MotionError("ended elsewhere"),
        GraspError("stuck"),
        ConnectionLost("gone"),
        PhysicsError((Problem(ProblemKind.STRETCH, 0, 2.1, 2.0),)),
    ],
    ids=lambda error: type(error).__name__,
)
def test_with_nobody_there_other_errors_stop_the_arm(
    tmp_path: Path, error: WarpDeformError
) -> None:
    arm = Arm(error)
    result, _ = episode(tmp_path / "a", arm, [ACTION] * 2)
    assert result.error is error and result.outcomes == ()
    assert arm.count("stop") == (0 if isinstance(error, ConnectionLost) else 1)
    score = score_recording(tmp_path / "a")
    assert score.success is False and score.warnings == ("action 1 was begun, and did not end",)
    (row,) = replay_recording(tmp_path / "a").rows
    assert row["action"][:2] == list(ACTION.pick_xy) and row["outcome"] is None


def test_an_operator_confirms_skips_stops_and_clears(tmp_path: Path) -> None:
    person = Person(Answer.SKIP, Answer.DO, Answer.STOP)
    arm = Arm(UserStopped("pressed"))
    result, chooser = episode(tmp_path / "a", arm, [ACTION] * 3, operator=person)
    assert result.outcome == "stopped" and result.outcomes == ("aborted",)
    assert [len(seen.refused) for seen in chooser.seen] == [0, 1, 0]
    assert [type(problem) for problem in person.problems] == [UserStopped]
    proposal = person.proposals[0]
    assert proposal.action == ACTION and proposal.number == 1 and proposal.overlay is not None
    assert proposal.poses["grasp"][2, 3] == pytest.approx(TWIN.foam_height_m + 0.010)


def test_the_way_home_is_confirmed_too(tmp_path: Path) -> None:
    arm = Arm()
    arm.move_joints(np.array(arm.config.q) + 0.1, speed=0.1)
    moved = arm.count("move_joints")
    result, _ = episode(tmp_path / "a", arm, [ACTION], operator=Person(Answer.STOP))
    assert result.outcome == "stopped" and arm.count("move_joints") == moved


def test_a_picture_without_foam_is_asked_about(tmp_path: Path) -> None:
    """An arm of the operator's over a third of the workspace."""
    good = drawn_camera(lambda: 0.45)
    bad = good.read().rgb
    bad[::3] = 255
    frames = [frame_of(bad)]

    class Hidden:
        def read(self) -> object:
            return frames.pop() if frames else good.read()

    person = Person()
    with recorder(tmp_path / "a") as made:
        result = run_episode(
            SafeRobot(Arm(), LIMITS),
            Hidden(),
            CALIBRATION,
            Listed([None]),
            recorder=made,
            goal=GOAL,
            operator=person,
        )
    assert result.outcome == "stopped" and len(person.problems) == 1


def test_ctrl_c_stops_the_arm_and_is_recorded(tmp_path: Path) -> None:
    arm = Arm(KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        episode(tmp_path / "a", arm, [ACTION])
    assert arm.count("stop") >= 1
    assert Recording.read(tmp_path / "a").meta["outcome"] == "stopped"


def test_a_killed_episode_is_scored_and_replayed(tmp_path: Path, capfd: object) -> None:
    """SIGKILL in the middle of the third action or so: what was done before is there."""
    folder = tmp_path / "a"
    script = [sys.executable, str(SHARED / "fixtures" / "franka_episodes.py"), str(folder)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(SHARED)])}
    with subprocess.Popen(script, stdout=subprocess.PIPE, text=True, env=environment) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if line.startswith("action 2"):
                break
        os.kill(process.pid, signal.SIGKILL)
    recording = Recording.read(folder)
    assert recording.meta["outcome"] is None and len(recording.actions) >= 2
    assert command(["franka", "score", str(folder), "--json"]) == 0
    assert command(["franka", "replay", str(folder), "--json"]) == 0
    assert len(score_recording(folder).iou) == len(recording.observations)


def test_the_terminal_asks_until_it_understands() -> None:
    said = iter(["what", "s", "", "q", "", "Q"])
    asked: list[str] = []

    def ask(text: str) -> str:
        asked.append(text)
        return next(said)

    terminal = TerminalOperator(ask)
    proposal = Proposal(ACTION, {"grasp": np.eye(4)}, None, 1)
    assert [terminal.confirm(proposal) for _ in range(3)] == [Answer.SKIP, Answer.DO, Answer.STOP]
    assert "(0.450, 0.000)" in asked[0] and "deg" in asked[0]
    assert terminal.go_on(ReflexError("met")) and not terminal.go_on(ReflexError("met"))


def test_goal_and_calibration_must_fit(tmp_path: Path) -> None:
    with (
        recorder(tmp_path / "a") as made,
        drawn_camera(lambda: 0.45) as camera,
        pytest.raises(InputError, match="pixels"),
    ):
        run_episode(
            SafeRobot(Arm(), LIMITS),
            camera,
            CALIBRATION,
            Listed([]),
            recorder=made,
            goal=GOAL[:-1],
        )
    assert not RigConfig(robot="panda").moves and RigConfig(robot="panda", execute=True).real


@pytest.mark.emulator
@pytest.mark.timeout(480)
def test_a_whole_episode_through_the_vendors_client(tmp_path: Path) -> None:
    """Policy, safety, panda-python, emulator, twin, camera, mask, overlap; recorded and read."""
    from fixtures import emulator_client  # noqa: F401  skips where the vendor has no wheels

    from hardware.backends.franka_config import NetworkedConfig
    from hardware.backends.panda import PandaRobot

    config = TwinConfig(seed=7)
    world = functools.partial(CableTwin, config)
    targets = chain(0.52)[:, :2]
    start, goal = chain(0.45)[:, :2], TASK.mask(targets)
    with EmulatorProcess(world=world, free_host=True) as emulator:
        look = functools.partial(emulator.call_world, "look")
        emulator.call_world("lay", beads=chain(0.45))
        calibration = sim_calibration(config, SMALL)
        camera = SimCamera(look, twin=config, config=SMALL)
        chooser = PolicyChooser(POLICY)
        with (
            PandaRobot(NetworkedConfig(host=emulator.host)) as panda,
            recorder(tmp_path / "a", goal=goal) as made,
        ):
            limits = replace(LIMITS, max_joint_speed=0.2)
            result = run_episode(
                SafeRobot(panda, limits),
                camera,
                calibration,
                chooser,
                recorder=made,
                goal=goal,
                config=EpisodeConfig(max_actions=1),
            )
        after = look()
        seen = segment_cable(config.view.rectify(SimCamera(look).read().rgb, sim_calibration()))
    beads = after.beads[:, :2]
    assert result.outcomes == ("placed",) and result.score is not None
    ways = [np.linalg.norm(beads - targets[::way], axis=1).mean() for way in (1, -1)]
    assert min(ways) < 0.8 * 0.07
    again = score_recording(tmp_path / "a")
    assert (again.iou, again.success) == (result.score.iou, result.score.success)
    found = replay_recording(tmp_path / "a")
    assert (found.mismatches, found.actions) == (0, 1)
    recording = Recording.read(tmp_path / "a")
    (row,) = recording.actions
    assert row["gripper_width_after_lift_m"] == pytest.approx(2 * config.chain.radius, abs=2e-4)
    picked = np.linalg.norm(start - row["action"][:2], axis=1)
    placed = np.linalg.norm(beads - row["action"][3:5], axis=1)
    assert placed.min() < 8e-3 and abs(placed.argmin() - picked.argmin()) < 10
    assert mask_iou(seen, TASK.mask(beads)) > 0.9
    assert mask_iou(seen, TASK.mask(start)) < 0.6
    moving = [row for row in recording.robot if row.get("mode") == "moving"]
    assert len(moving) > 5 and len({tuple(row["q"]) for row in moving}) > 3
