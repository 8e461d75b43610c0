"""One episode in a closed loop: look, choose, check, confirm, do, and record all of it.

What happens when something goes wrong:

- a proposed action that the safety limits refuse: nothing moves, the chooser proposes another;
- a missed grasp, or a descent that met something: recorded, and the episode goes on;
- a reflex, the user stop, a motion that ended elsewhere: the operator is asked, until it is cleared
  or given up; during an action "go on" recovers the arm, lets go, goes home and records the action
  as aborted; nobody there means that only reflexes are recovered from, as often as the limits
  allow;
- a picture that shows no cable on foam: the operator is asked whether to take another;
- a cable that lies at its goal before the first action: it is tossed again where it is simulated;
  elsewhere the operator is asked to, and nobody there ends the episode, which is no success;
- anything else (a limit broken on the way, a lost connection, a blocked gripper, a twin whose
  simulation cannot be trusted any more): the arm is stopped and the episode ends with the error as
  its outcome.

Source: Seita et al., ICRA 2021, section on physical experiments: pictures from the home pose, at
most 10 actions, success at an overlap of more than 0.25.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from warp_deform.errors import InputError, WarpDeformError
from warp_deform.xpbd.guards import PhysicsError

from ..arm.pick_place import (
    PickPlaceAction,
    PickPlaceConfig,
    PickPlaceOutcome,
    PickPlaceResult,
    execute,
    refusal,
    waypoints,
)
from ..arm.robot import ConnectionLost, MotionError, RobotError
from ..arm.safe_robot import SafeRobot
from ..calibration.calibration import Calibration
from ..cameras.camera import Camera, CameraError, Frame
from ..recordings.recorder import EpisodeRecorder
from ..recordings.scoring import MAX_ACTIONS, SUCCESS_IOU, EpisodeScore, StartAtGoal, score_masks
from ..vision.overlay import draw_action
from ..vision.segmentation import SegmentationConfig, SegmentationError, segment_cable
from ..vision.top_down_view import TopDownView
from .operators import Answer, Operator, Proposal, Unattended, until_cleared

__all__ = ["Chooser", "EpisodeConfig", "EpisodeResult", "Observation", "run_episode"]

# A joint farther than this from home is sent there once more before a picture is taken [rad]: an
# arrival may miss by 2 degrees, which a camera on the hand sees as a shift of up to 2 cm.
_AT_HOME = 0.01
_MOST_PROPOSALS = 20
_MOST_TOSSES = 20


@dataclass(frozen=True, kw_only=True)
class EpisodeConfig:
    """How an episode goes."""

    max_actions: int = MAX_ACTIONS
    """Actions that it may take."""
    until_success: bool = True
    """Whether it ends as soon as it succeeds."""
    pick_place: PickPlaceConfig = field(default_factory=PickPlaceConfig)
    """Heights, forces and openings."""
    segmentation: SegmentationConfig = field(default_factory=SegmentationConfig)
    """What counts as cable."""
    view: TopDownView = field(default_factory=TopDownView)
    """The workspace and its pixels."""
    rate_hz: float = 10.0
    """Readings of the robot recorded a second."""

    def __post_init__(self) -> None:
        if not 1 <= self.max_actions <= 1000:
            raise InputError(f"max_actions is {self.max_actions}; it must be 1 to 1000")

    def to_record(self) -> dict[str, Any]:
        """Return the configuration as JSON types."""
        return asdict(self)


@dataclass(frozen=True, eq=False)
class Observation:
    """What a chooser sees.

    Attributes:
        index: how many actions were taken before
        view: the workspace from above, (H, W, 3) uint8
        mask: the cable in it, (H, W) bool
        goal: the mask to reach, (H, W) bool; None without a goal
        last: what became of the action before; None at first
        refused: actions proposed on this picture that were refused or skipped
    """

    index: int
    view: np.ndarray
    mask: np.ndarray
    goal: np.ndarray | None
    last: PickPlaceOutcome | None
    refused: tuple[PickPlaceAction, ...] = ()


class Chooser(Protocol):
    """Chooses the actions of an episode; every agent that `--agent` names is one.

    Attributes:
        name: of the agent, for recordings and messages
    """

    name: str

    def reset(self) -> None:
        """Forget the episode before."""
        ...

    def choose(self, seen: Observation) -> PickPlaceAction | None:
        """Return the next action; None where there is nothing to do, which ends the episode.

        It is asked again on the same picture, with the action among `seen.refused`, where the
        safety limits or the operator refuse one.
        """
        ...


@dataclass(frozen=True, eq=False)
class EpisodeResult:
    """How an episode went.

    Attributes:
        folder: where it is recorded
        outcome: "success", "limit", "stopped" or "error: ..."
        outcomes: what became of each action
        score: overlaps and success; None without a goal
        error: what ended it, if something did
    """

    folder: Path
    outcome: str
    outcomes: tuple[PickPlaceOutcome, ...]
    score: EpisodeScore | None
    error: WarpDeformError | None


def run_episode(
    robot: SafeRobot,
    camera: Camera,
    calibration: Calibration,
    chooser: Chooser,
    *,
    recorder: EpisodeRecorder,
    goal: np.ndarray | None = None,
    config: EpisodeConfig | None = None,
    operator: Operator | None = None,
    empty: np.ndarray | None = None,
    toss: Callable[[int], None] | None = None,
    say: Callable[[str], None] = lambda line: None,
    show: Callable[[Frame, Observation, np.ndarray], None] | None = None,
) -> EpisodeResult:
    """Run an episode; the recorder is finished afterwards.

    Args:
        robot: acts
        camera: sees the workspace from the home pose
        calibration: of this robot and this camera
        chooser: decides what to do
        recorder: keeps all of it
        goal: the mask to reach, (H, W) bool; without one there is no score
        config: how the episode goes
        operator: who confirms every proposal; default: nobody, see `Unattended`
        empty: the view of the foam without a cable, (H, W, 3) uint8, see `segment_cable`
        toss: tosses a simulated cable again, given how often it was; see the module
        say: takes what goes on, a line each time
        show: takes what is seen before every action, and the view with the masks' outlines

    Raises:
        InputError: goal and view differ in size, or the calibration belongs to another home pose
        KeyboardInterrupt: Ctrl-C; the arm was stopped and the recording says "stopped"
    """
    config = config or EpisodeConfig()
    if goal is not None and goal.shape != config.view.shape:
        raise InputError(f"the goal has {goal.shape} pixels, the view {config.view.shape}")
    episode = _Episode(
        robot=robot,
        camera=camera,
        calibration=calibration,
        chooser=chooser,
        recorder=recorder,
        goal=goal,
        config=config,
        operator=operator or Unattended(),
        empty=empty,
        toss=toss,
        say=say,
        show=show,
    )
    robot.begin_episode()
    chooser.reset()
    error: WarpDeformError | None = None
    try:
        with recorder.following(robot, rate_hz=config.rate_hz):
            outcome = episode.run()
    except KeyboardInterrupt:
        robot.stop()
        recorder.finish("stopped")
        raise
    except (RobotError, CameraError, SegmentationError, PhysicsError, StartAtGoal) as problem:
        error = problem
        outcome = f"error: {type(problem).__name__}: {' '.join(str(problem).split())}"
        if not isinstance(problem, ConnectionLost):
            robot.stop()
    recorder.finish(outcome)
    score = None if goal is None or not episode.masks else score_masks(episode.masks, goal)
    return EpisodeResult(recorder.folder, outcome, tuple(episode.outcomes), score, error)


@dataclass(eq=False)
class _Episode:
    """An episode while it runs."""

    robot: SafeRobot
    camera: Camera
    calibration: Calibration
    chooser: Chooser
    recorder: EpisodeRecorder
    goal: np.ndarray | None
    config: EpisodeConfig
    operator: Operator
    empty: np.ndarray | None
    toss: Callable[[int], None] | None
    say: Callable[[str], None]
    show: Callable[[Frame, Observation, np.ndarray], None] | None
    masks: list[np.ndarray] = field(default_factory=list)
    outcomes: list[PickPlaceOutcome] = field(default_factory=list)

    def run(self) -> str:
        """Return the outcome."""
        if not self._at_home():
            if self.operator.confirm(Proposal(None, {}, None, 0)) is not Answer.DO:
                return "stopped"
            until_cleared(self.robot, self.operator, self.robot.home)
        while True:
            actions = len(self.outcomes)
            frame, view, mask = self._look() if actions else self._look_at_start()
            self.masks.append(mask)
            last = self.outcomes[-1] if actions else None
            seen = Observation(actions, view, mask, self.goal, last)
            self._record(frame, seen)
            overlap = self._overlap(mask)
            solved = overlap > SUCCESS_IOU
            if solved and not actions:
                raise StartAtGoal(overlap)
            if actions >= self.config.max_actions or (solved and self.config.until_success):
                return "success" if self._succeeded() else "limit"
            action = self._choose(seen)
            if action is None:
                return "success" if self._succeeded() else "stopped"
            self._do(action)

    def _succeeded(self) -> bool:
        goal = self.goal
        return goal is not None and score_masks(self.masks, goal).success

    def _at_home(self) -> bool:
        return bool(np.abs(self.robot.state().q - self.calibration.home_q).max() < _AT_HOME)

    def _look(self) -> tuple[Frame, np.ndarray, np.ndarray]:
        """A picture from the home pose, the workspace from above, and the cable's mask."""
        if not self._at_home():
            until_cleared(self.robot, self.operator, self.robot.home)
        if not self.robot.stands_at(self.calibration.home_q):
            raise InputError(
                "the arm does not stand at the home pose of the calibration; give both the same"
            )
        while True:
            try:
                frame = self.camera.read()
                view = self.config.view.rectify(frame.rgb, self.calibration)
                mask = segment_cable(view, config=self.config.segmentation, empty=self.empty)
            except (CameraError, SegmentationError) as problem:
                if not self.operator.go_on(problem):
                    raise
                continue
            return frame, view, mask

    def _look_at_start(self) -> tuple[Frame, np.ndarray, np.ndarray]:
        """A picture of a cable that is not at its goal yet, or of one that nobody tosses again."""
        for again in range(1, _MOST_TOSSES + 1):
            seen = self._look()
            overlap = self._overlap(seen[2])
            if overlap <= SUCCESS_IOU:
                break
            problem = StartAtGoal(overlap)
            if self.toss is not None:
                self.say(f"{problem}: tossed again")
                self.toss(again)
            elif not self.operator.go_on(problem):
                break
        return seen

    def _overlap(self, mask: np.ndarray) -> float:
        """With the goal; 0 without one."""
        return 0.0 if self.goal is None else score_masks([mask], self.goal).iou[0]

    def _record(self, frame: Frame, seen: Observation) -> None:
        drawn = self._drawn(seen, None)
        iou = self.recorder.observe(frame, seen.view, seen.mask, overlay=drawn)
        if self.show is not None:
            self.show(frame, seen, drawn)
        score = "" if iou is None else f", overlap {iou:.3f}"
        self.say(f"after {seen.index} actions: {np.count_nonzero(seen.mask)} px of cable{score}")

    def _drawn(self, seen: Observation, action: PickPlaceAction | None) -> np.ndarray:
        view = self.config.view
        return draw_action(seen.view, view, mask=seen.mask, goal=seen.goal, action=action)

    def _choose(self, seen: Observation) -> PickPlaceAction | None:
        """An action that is allowed and confirmed; None where there is none, or to stop.

        The recorded overlay is that of the action; of none, where none is confirmed.
        """
        refused: list[PickPlaceAction] = []
        while True:
            now = replace(seen, refused=tuple(refused))
            action = self.chooser.choose(now)
            if action is None:
                self.say(f"{self.chooser.name} sees nothing to do")
                return None
            error = self._refusal(action)
            if error is None:
                answer = self.operator.confirm(self._proposal(seen, action))
                if answer is Answer.DO:
                    return action
                self.recorder.show(self._drawn(seen, None))
                if answer is Answer.STOP:
                    return None
            elif len(refused) + 1 >= _MOST_PROPOSALS:
                raise error
            else:
                self.say(f"refused: {error}")
            refused.append(action)

    def _refusal(self, action: PickPlaceAction) -> WarpDeformError | None:
        """Why an action would be refused; a robot that accepts no motion at all is asked about."""
        attempt = functools.partial(refusal, self.robot, action, self.config.pick_place)
        return until_cleared(self.robot, self.operator, attempt)

    def _proposal(self, seen: Observation, action: PickPlaceAction) -> Proposal:
        overlay = self._drawn(seen, action)
        poses = waypoints(action, self.robot.limits.table, self.config.pick_place)
        return Proposal(action, poses, overlay, seen.index + 1, self.recorder.show(overlay))

    def _do(self, action: PickPlaceAction) -> None:
        view, config = self.config.view, self.config.pick_place
        pick, place = (
            tuple(view.base_to_pixel(np.array(xy)).tolist())
            for xy in (action.pick_xy, action.place_xy)
        )
        self.recorder.begin_action(action, self._lift(action), pick_pixel=pick, place_pixel=place)
        try:
            result = execute(self.robot, action, config)
        except MotionError as problem:
            self.say(f"action {len(self.outcomes) + 1}: {problem}")
            result = self._recovered(action, problem)
        self.recorder.end_action(action, result, pick_pixel=pick, place_pixel=place)
        self.outcomes.append(result.outcome)
        self.say(f"action {len(self.outcomes)}: {result.outcome}")

    def _lift(self, action: PickPlaceAction) -> float:
        """The height at which an action carries [m]."""
        limits = self.robot.limits
        poses = waypoints(action, limits.table, self.config.pick_place)
        return float(limits.height(poses["lift"]))

    def _recovered(self, action: PickPlaceAction, problem: MotionError) -> PickPlaceResult:
        """Recover the arm, let go and go home; what became of the cable shows the next picture."""
        config, robot = self.config.pick_place, self.robot
        force = float(np.linalg.norm(robot.state().force_N[:3]))

        def let_go() -> None:
            robot.open_gripper(config.release_width_m)
            robot.home()

        until_cleared(robot, self.operator, let_go, problem=problem)
        grasp = waypoints(action, robot.limits.table, config)["grasp"]
        lift, outcome = self._lift(action), PickPlaceOutcome.ABORTED
        return PickPlaceResult(outcome, grasp, None, None, None, lift, force)
