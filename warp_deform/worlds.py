"""`Worlds`: several episodes of one task side by side, reset, acted on and looked at.

This is where tasks, robot, solver and renderer meet. Episodes share SIMD lanes but nothing else: an
episode's bits depend on its seed and its actions only, not on its neighbours or its slot.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import newton
import numpy as np

from .episodes import Goal, state_hash
from .errors import InputError, WarpDeformError
from .objects.box import Box
from .objects.cable import Cable
from .rendering.drawables import Drawables
from .rendering.pixels import BOUNDS
from .rendering.topdown import TopDown
from .robots import robot as find_robot
from .robots.primitive import (
    Motion,
    Outcome,
    approach,
    carry,
    find_grasp,
    solve_joints,
)
from .rollout import Frames, GripPath, rollout
from .solver.guards import Problem
from .solver.solver import SolverFusedXPBD
from .tasks.free_space import FreeSpace
from .tasks.registry import task as find_task
from .tasks.task import Images, Layout, Snapshot, Task

__all__ = ["Episode", "StepReport", "Worlds", "episode_rng"]

LAYOUT_STREAM, DEMONSTRATOR_STREAM = 0, 1
"""Random streams of an episode: where things start, and what the demonstrator draws."""

MOST_STARTS = 100
"""Starts that are drawn before a seed is given up; the tasks need 1 to 3."""
REST_LIMIT = 4.0
"""A world that does not come to rest is looked at so long after its release or settling time [s]."""
CALM = 0.2
"""After a release, speeds stay under `calm_speed` for so long [s]: what the released bead's links and
the beads under it had stored is dissipated instead of flinging it."""
RETREAT_LEAST = 0.3
"""A world runs at least so long after a release, while the tip retreats [s]."""


def episode_rng(seed: int, stream: int) -> np.random.Generator:
    """Random generator of one episode for one purpose; streams do not overlap."""
    return np.random.default_rng([int(seed), stream])


@dataclass(eq=False)
class Episode:
    """One running episode."""

    seed: int
    layout: Layout
    drawables: Drawables
    goal: Goal | None
    discarded_starts: int
    sim_seconds: float = 0.0
    actions: int = 0
    problems: tuple[Problem, ...] = ()
    snapshot: Snapshot = field(init=False)

    @property
    def physics_ok(self) -> bool:
        """Whether no guard has fired since the start."""
        return not self.problems


@dataclass(frozen=True, eq=False)
class StepReport:
    """What one action did.

    motions and joints: the tip's way-points and the arm's, of the approach and of the carry
    frames: recorded states, when asked for, at times from the beginning of the action
    """

    outcome: Outcome
    seconds: float
    motions: tuple[Motion, ...]
    joints: tuple[np.ndarray | None, ...]
    frames: Frames | None


class Worlds:
    """`count` episodes of a task.

        worlds = Worlds("cable-ring", 8)
        worlds.reset({slot: seed for slot, seed in enumerate(range(8))})
        reports = worlds.step({slot: action, ...})
        worlds.episodes[slot].snapshot.images.color

    robot: "ur5" or "panda"; lanes: see `SolverFusedXPBD`; reject_solved: draw another start when the
    first one already solves the task.
    """

    def __init__(
        self,
        task: str | Task,
        count: int = 1,
        *,
        robot: str = "ur5",
        lanes: int | None = None,
        precision: str = "float32",
    ) -> None:
        self.task = find_task(task) if isinstance(task, str) else task
        self.robot = find_robot(robot)
        self.count = count
        one = newton.ModelBuilder()
        SolverFusedXPBD.register_custom_attributes(one)
        self.objects: tuple[Cable | Box, ...] = self.task.add_objects(one)
        builder = newton.ModelBuilder()
        SolverFusedXPBD.register_custom_attributes(builder)
        builder.replicate(one, count)
        self.model = builder.finalize(device="cpu")
        self.solver = SolverFusedXPBD(
            self.model, self.task.solver, lanes=lanes, precision=precision
        )
        self.episodes: dict[int, Episode] = {}
        self._topdown = TopDown()
        self._space = FreeSpace(reach=self._reach())

    def _reach(self) -> tuple[float, float]:
        """Radii that the tip reaches at every height a task uses."""
        heights = [0.01, *(stage.lift for stage in self.task.stages)]
        radii = [self.robot.reach(z) for z in heights]
        return max(r[0] for r in radii), min(r[1] for r in radii)

    # -- starting

    def reset(self, seeds: Mapping[int, int], *, goals: Mapping[int, Goal] | None = None) -> None:
        """Start an episode with the given seed in every named slot.

        A goal-conditioned task gets the goal from `goals`, or constructs one from the seed.

        Raises:
            WarpDeformError: a seed gave no valid start.
        """
        for slot in seeds:
            if not 0 <= slot < self.count:
                raise InputError(f"slot {slot} is not one of the {self.count} worlds")
        goals = goals or {}
        rngs = {slot: episode_rng(seed, LAYOUT_STREAM) for slot, seed in seeds.items()}
        discarded = dict.fromkeys(seeds, 0)
        waiting = list(seeds)
        for _ in range(MOST_STARTS):
            if not waiting:
                return
            layouts = {s: self.task.sample(rngs[s], self._space) for s in waiting}
            made = {s: goals[s] for s in waiting if s in goals}
            if self.task.goal_conditioned:
                made |= self._construct_goals(
                    {s: layouts[s] for s in waiting if s not in made}, seeds
                )
                layouts = {s: l.with_targets(made[s].targets) for s, l in layouts.items()}
            self._start(layouts, seeds, made)
            again = []
            for s in waiting:
                self.episodes[s].discarded_starts = discarded[s]
                if not self._acceptable(self.episodes[s]):
                    discarded[s] += 1
                    again.append(s)
            waiting = again
        if waiting:
            names = ", ".join(str(seeds[s]) for s in waiting)
            raise WarpDeformError(
                f"{self.task.name}: no valid start in {MOST_STARTS} draws for seed {names}"
            )

    def _start(
        self, layouts: Mapping[int, Layout], seeds: Mapping[int, int], goals: Mapping[int, Goal]
    ) -> None:
        """Place the objects, disturb them and let them settle."""
        data = self.solver.data
        for slot, layout in layouts.items():
            if len(layout.particle_q):
                data.lane("particles.x", slot)[:] = layout.particle_q
                data.lane("particles.v", slot)[:] = 0.0
            if len(layout.body_q):
                data.set_bodies(slot, layout.body_q)
        least = {
            s: l.settle_seconds + (l.push.seconds if l.push else 0.0) for s, l in layouts.items()
        }
        results = rollout(
            self.solver,
            list(layouts),
            pushes={s: l.push for s, l in layouts.items() if l.push},
            least=least,
            most={s: seconds + REST_LIMIT for s, seconds in least.items()},
            calm={s: l.settle_seconds if l.calm else 0.0 for s, l in layouts.items()},
        )
        for slot, layout in layouts.items():
            drawables = Drawables.of(self.task.drawn(layout, self.objects))
            episode = Episode(seeds[slot], layout, drawables, goals.get(slot), 0)
            episode.sim_seconds = results[slot].seconds
            episode.problems = results[slot].watch.problems(slot, self.solver.config.limits)
            self.episodes[slot] = episode
            self._look(slot)

    def _construct_goals(
        self, layouts: Mapping[int, Layout], seeds: Mapping[int, int]
    ) -> dict[int, Goal]:
        """Goals with the objects placed at the sampled targets and settled."""
        if not layouts:
            return {}
        self._start({s: self.task.goal_layout(l) for s, l in layouts.items()}, seeds, {})
        return {s: self.as_goal(s, kind="constructed") for s in layouts}

    def as_goal(self, slot: int, *, kind: str) -> Goal:
        """The present state of a slot as a goal; kind: "constructed" or "demonstrated"."""
        snapshot = self.episodes[slot].snapshot
        targets = self.task.goal_targets(snapshot)
        images = snapshot.images
        return Goal(images.color, images.height, targets, kind, self.episodes[slot].seed)

    def _acceptable(self, episode: Episode) -> bool:
        """Whether a start is valid: trusted physics, everything on the table, not solved yet."""
        if not episode.physics_ok:
            return False
        snapshot = episode.snapshot
        points = np.concatenate([snapshot.particle_q[:, :2], snapshot.body_q[:, :2]])
        (x0, x1), (y0, y1) = BOUNDS[:2]
        inside = (points >= (x0, y0)).all() and (points <= (x1, y1)).all()
        return bool(inside) and not self.task.solved(episode.layout, snapshot)

    # -- acting

    def step(
        self, actions: Mapping[int, np.ndarray], *, record: float = 0.0
    ) -> dict[int, StepReport]:
        """Run one pick-and-place in every named slot and let the worlds come to rest.

        actions: (7,) each, pick x, y [m], yaw [rad], place x, y, yaw, lift [m]; finite.
        record: interval of recorded frames [s]; 0 records nothing.
        """
        actions = {s: np.asarray(a, dtype=float) for s, a in actions.items()}
        for slot, action in actions.items():
            if action.shape != (7,) or not np.isfinite(action).all():
                raise InputError(f"an action needs 7 finite numbers, got {action}")
            if slot not in self.episodes:
                raise InputError(f"slot {slot} has no episode: reset it first")
        grasps, approaches, joints = self._plan_approach(actions)
        waits = {s: m.seconds for s, m in approaches.items()}
        before = rollout(self.solver, list(actions), least=1e3, most=waits, record=record)
        carries: dict[int, Motion] = {}
        paths: dict[int, GripPath] = {}
        for slot, grasp in grasps.items():
            if grasp is not None:
                carries[slot], paths[slot] = self._plan_carry(slot, actions[slot], grasp)
        carry_joints = dict(
            zip(carries, solve_joints(self.robot, list(carries.values())), strict=True)
        )
        paths = {
            s: p for s, p in paths.items() if carry_joints[s] is not None and joints[s] is not None
        }
        after = self._run_paths(paths, record) if paths else {}
        reports = {}
        for slot in actions:
            episode = self.episodes[slot]
            runs = [before[slot], *([after[slot]] if slot in after else [])]
            limits = self.solver.config.limits
            for run in runs:
                episode.sim_seconds += run.seconds
                episode.problems += run.watch.problems(slot, limits)
            episode.actions += 1
            self._look(slot)
            motions = (approaches[slot], *([carries[slot]] if slot in carries else []))
            reports[slot] = StepReport(
                outcome=self._outcome(episode, slot, paths, joints, carry_joints),
                seconds=sum(run.seconds for run in runs),
                motions=motions,
                joints=(joints[slot], *([carry_joints[slot]] if slot in carries else [])),
                frames=_join([run.frames for run in runs], [run.seconds for run in runs]),
            )
        return reports

    def _plan_approach(self, actions: Mapping[int, np.ndarray]) -> tuple[dict, dict, dict]:
        """What the tip will meet, its motion there, and the arm's way-points (None: unreachable)."""
        config = self.task.primitive
        grasps, motions = {}, {}
        for slot, action in actions.items():
            snapshot = self.episodes[slot].snapshot
            pick = action[:3]
            grasps[slot] = find_grasp(
                pick, self.objects, snapshot.particle_q, snapshot.body_q, config
            )
            hover = self.robot.hover_height(pick[0], pick[1], config.hover)
            height = grasps[slot].height if grasps[slot] else 0.0
            start = self._tip(slot)
            motions[slot] = approach(start, pick, hover, height, config)
        joints = dict(zip(motions, solve_joints(self.robot, list(motions.values())), strict=True))
        return grasps, motions, joints

    def _plan_carry(self, slot: int, action: np.ndarray, grasp) -> tuple[Motion, GripPath]:
        snapshot = self.episodes[slot].snapshot
        speed = self.task.speed(float(action[6]))
        if grasp.particle is not None:
            radius = next(o for o in self.objects if isinstance(o, Cable)).config.radius
            lowest = float(snapshot.particle_q[grasp.particle, 2]) - radius
        else:
            box = next(o for o in self.objects if isinstance(o, Box) and o.body == grasp.body)
            lowest = float(snapshot.body_q[grasp.body, 2]) + box.config.lowest
        floor = grasp.height - lowest
        hover = self.robot.hover_height(action[3], action[4], self.task.primitive.hover)
        return carry(action, grasp, speed, floor, hover, self.task.primitive)

    def _run_paths(self, paths: Mapping[int, GripPath], record: float):
        most = {s: float(p.times[-1]) + REST_LIMIT for s, p in paths.items()}
        return rollout(
            self.solver,
            list(paths),
            paths=paths,
            least=RETREAT_LEAST,
            most=most,
            calm_after=CALM,
            record=record,
        )

    def _tip(self, slot: int) -> np.ndarray:
        """Where the tip waits: above the middle of the table."""
        x, y = 0.5, 0.0
        return np.array([x, y, self.robot.hover_height(x, y, self.task.primitive.hover), 0.0])

    def _outcome(self, episode: Episode, slot: int, paths, joints, carry_joints) -> Outcome:
        if not episode.physics_ok:
            return Outcome.INVALID
        if slot in paths:
            return Outcome.PLACED
        if joints[slot] is None or carry_joints.get(slot, ()) is None:
            return Outcome.UNREACHABLE
        return Outcome.MISSED

    # -- looking

    def _look(self, slot: int) -> None:
        """Take a snapshot of a slot's state."""
        data, episode = self.solver.data, self.episodes[slot]
        particle_q = np.array(data.lane("particles.x", slot), np.float32)
        particle_qd = np.array(data.lane("particles.v", slot), np.float32)
        poses, twists = data.body_poses(slot)
        body_q, body_qd = poses.astype(np.float32), twists.astype(np.float32)
        drawables, topdown = episode.drawables, self._topdown
        ok = np.isfinite(particle_q).all() and np.isfinite(body_q).all()

        def render() -> Images:
            if not ok:
                raise WarpDeformError("a state that is not finite cannot be drawn")
            return topdown.render(drawables, particle_q, body_q)

        episode.snapshot = Snapshot(
            particle_q, particle_qd, body_q, body_qd, drawables.segments, render
        )

    def score(self, slot: int) -> float:
        """The task's score of a slot's state; 0 when the physics cannot be trusted."""
        episode = self.episodes[slot]
        return self.task.score(episode.layout, episode.snapshot) if episode.physics_ok else 0.0

    def solved(self, slot: int) -> bool:
        """Whether a slot's task is done; never on an untrusted state."""
        episode = self.episodes[slot]
        return episode.physics_ok and self.task.solved(episode.layout, episode.snapshot)

    def hash(self, slot: int) -> str:
        """Hash of a slot's positions and velocities."""
        s = self.episodes[slot].snapshot
        return state_hash(s.particle_q, s.particle_qd, s.body_q, s.body_qd)


def _join(frames: Sequence[Frames | None], seconds: Sequence[float]) -> Frames | None:
    """Frames of consecutive rollouts as one recording."""
    begins = np.concatenate([[0.0], np.cumsum(seconds)])
    there = [(f, b) for f, b in zip(frames, begins, strict=False) if f is not None]
    if not there:
        return None
    return Frames(
        np.concatenate([f.times + b for f, b in there]),
        np.concatenate([f.particle_q for f, _ in there]),
        np.concatenate([f.body_q for f, _ in there]),
    )
