"""An episode while it runs: its state, the execution of its present action, and what came of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..episodes import Goal
from ..objects.scene_object import SceneObject, box_of, object_of
from ..rendering.drawables import Drawables
from ..robots.arm import Robot
from ..robots.primitive import Grasp, Motion, Outcome, carry, find_grasp
from ..rollout.rollouts import Frames, GripPath, Rollout
from ..tasks.history import Aloft, PastAction
from ..tasks.task import Layout, Snapshot, Task
from ..xpbd.guards import Problem

__all__ = [
    "ALOFT_EVERY",
    "DEMONSTRATOR_STREAM",
    "LAYOUT_STREAM",
    "Carry",
    "Execution",
    "OnCarry",
    "RunningEpisode",
    "StepReport",
    "aloft",
    "episode_rng",
    "objects_in",
]

LAYOUT_STREAM, DEMONSTRATOR_STREAM = 0, 1
"""Random streams of an episode: where things start, and what the demonstrator draws."""
ALOFT_EVERY = 0.1
"""Interval [s] of the states among which `aloft` looks; shorter than a stage's rest aloft."""


def episode_rng(seed: int, stream: int) -> np.random.Generator:
    """Random generator of one episode for one purpose; streams do not overlap."""
    return np.random.default_rng([int(seed), stream])


def objects_in(layout: Layout, objects: tuple[SceneObject, ...]) -> tuple[SceneObject, ...]:
    """A world's objects as an episode with this layout has them."""
    return tuple(
        replace(item, config=layout.configs[i]) if i in layout.configs else item  # type: ignore[arg-type]
        for i, item in enumerate(objects)
    )


@dataclass(eq=False, kw_only=True)
class RunningEpisode:
    """One running episode."""

    seed: int
    layout: Layout
    objects: tuple[SceneObject, ...]
    drawables: Drawables
    goal: Goal | None
    discarded_starts: int
    goal_given: bool = False
    """Whether the start was drawn for the goal; else it made it."""
    sim_seconds: float = 0.0
    history: tuple[PastAction, ...] = ()
    """Actions so far, and what came of each."""
    ended: bool = False
    """Whether the last action ended it, solved or not, see `Task.ended`."""
    over: bool = False
    """Whether it had ended before its last action."""
    problems: tuple[Problem, ...] = ()
    at_rest: bool
    """Whether everything came to rest after the last motion before its time was up."""
    tip: np.ndarray
    """Where the tip waits: x, y, z [m], yaw [rad]."""
    posture: np.ndarray
    """Joint positions (dof,) [rad] from which the arm's next motion sets out."""
    snapshot: Snapshot = field(init=False)

    @property
    def physics_ok(self) -> bool:
        """Whether no guard has fired since the start."""
        return not self.problems

    def judge(self, task: Task) -> None:
        """Note whether the last action ended the episode; an untrusted state has no end."""
        self.ended = self.physics_ok and task.ended(self.layout, self.snapshot)

    @property
    def actions(self) -> np.ndarray:
        """Actions so far (T, 7)."""
        return np.array([past.action for past in self.history]).reshape(-1, 7)


@dataclass(frozen=True, eq=False)
class StepReport:
    """What one action did.

    Attributes:
        motions: the tip's waypoints, of the approach and of the carry
        joints: the arm's waypoints, of both
        frames: recorded states, when asked for, at times from the beginning of the action
    """

    outcome: Outcome
    seconds: float
    motions: tuple[Motion, ...]
    joints: tuple[np.ndarray | None, ...]
    frames: Frames | None


OnCarry = Callable[[Mapping[int, StepReport]], None]
"""Is told how tips came down to what they take, by slot; the carry is not computed yet."""


@dataclass(eq=False)
class Execution:
    """One action while it is carried out: what was done so far, and what came of it."""

    action: np.ndarray
    outcome: Outcome = Outcome.UNREACHABLE
    motions: list[Motion] = field(default_factory=list)
    joints: list[np.ndarray | None] = field(default_factory=list)
    runs: list[Rollout] = field(default_factory=list)
    held: int | None = None
    aloft: Aloft | None = None

    def grasp(self, task: Task, snapshot: Snapshot) -> Grasp | None:
        """What the tip meets when it descends at the pick point now."""
        s = snapshot
        return find_grasp(self.action[:3], s.objects, s.particle_q, s.body_q, task.primitive)

    def placed(self, run: Rollout, carried: Carry, path: GripPath) -> None:
        """Note that what the tip had taken was carried along `path` and let go."""
        self.runs.append(run)
        self.outcome = Outcome.PLACED
        self.held = carried.held
        if carried.task.looks_aloft:
            self.aloft = aloft(path, run.frames)

    def past(self, outcome: Outcome) -> PastAction:
        """What the episode remembers of it."""
        return PastAction(self.action, outcome, self.held, self.aloft)

    def report(self, outcome: Outcome, *, recorded: bool) -> StepReport:
        """What the action did; with its frames where somebody asked for them."""
        seconds = [run.seconds for run in self.runs]
        frames = _join_frames([run.frames for run in self.runs], seconds) if recorded else None
        return StepReport(outcome, sum(seconds), tuple(self.motions), tuple(self.joints), frames)

    def report_of_approach(self) -> StepReport:
        """What the tip did until it was down at what it takes, where nothing is carried yet."""
        (run,) = self.runs
        motions, joints = tuple(self.motions[:1]), tuple(self.joints[:1])
        return StepReport(self.outcome, run.seconds, motions, joints, run.frames)


@dataclass(frozen=True, eq=False)
class Carry:
    """How a tip carries what it has taken: called with an action, it tells the motion and the path.

    Attributes:
        radii: (P,), of the world's particles [m]
    """

    grasp: Grasp
    task: Task
    robot: Robot
    snapshot: Snapshot
    radii: np.ndarray

    @property
    def held(self) -> int:
        """Number of what is carried among the world's objects."""
        return object_of(self.snapshot.objects, self.grasp.particle, self.grasp.body)

    def __call__(self, action: np.ndarray) -> tuple[Motion, GripPath]:
        """Motion of the loaded tip, down to where what it holds would rest on the table."""
        grasp, snapshot = self.grasp, self.snapshot
        if grasp.particle is not None:
            lowest = snapshot.particle_q[grasp.particle, 2] - self.radii[grasp.particle]
        else:
            assert grasp.body is not None
            box = box_of(snapshot.objects, grasp.body)
            lowest = snapshot.body_q[box.body, 2] + box.config.lowest
        config = self.task.primitive
        hover = self.robot.hover_height(action[3], action[4], config.hover)
        stage, floor = self.task.stage_of(float(action[6])), grasp.height - float(lowest)
        return carry(action, grasp, stage, floor, hover, config)


def aloft(path: GripPath, frames: Frames | None) -> Aloft | None:
    """The last of `frames` before the tip leaves the highest stretch of `path`."""
    if frames is None:
        return None
    heights = np.asarray(path.positions)[:, 2]
    leaves = float(path.times[np.flatnonzero(heights >= heights.max() - 1e-9)[-1]])
    at = int(np.searchsorted(frames.times, leaves, side="right")) - 1
    return Aloft(frames.particle_q[at], frames.body_q[at])


def _join_frames(frames: Sequence[Frames | None], seconds: Sequence[float]) -> Frames | None:
    """Frames of consecutive rollouts as one recording."""
    begins = np.concatenate([[0.0], np.cumsum(seconds)])
    recorded = [(f, b) for f, b in zip(frames, begins, strict=False) if f is not None]
    if not recorded:
        return None
    return Frames(
        np.concatenate([f.times + b for f, b in recorded]),
        np.concatenate([f.particle_q for f, _ in recorded]),
        np.concatenate([f.body_q for f, _ in recorded]),
    )
