"""`Worlds`: several episodes of one task side by side, reset, acted on and looked at.

This is where tasks, robot, solver and renderer meet. Episodes share SIMD lanes but nothing else: an
episode's bits depend on its seed and its actions only, not on its neighbours or its slot.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import newton
import numpy as np

from ..episodes import Goal, state_hash
from ..errors import InputError, WarpDeformError
from ..objects.box import Box
from ..objects.scene_object import SceneObject
from ..rendering.drawables import Drawables
from ..rendering.images import Images
from ..rendering.pixels import BOUNDS
from ..rendering.topdown import TopDown
from ..robots import robot as find_robot
from ..robots.primitive import Motion, Outcome, solve_joints
from ..rollout.control import ControlLoop
from ..rollout.rollouts import rollout
from ..solver.solver import SolverFusedXPBD
from ..support.checked import real_array
from ..tasks.free_space import FreeSpace
from ..tasks.registry import task_of
from ..tasks.task import Layout, Snapshot, Task
from ..xpbd.config import WORLD_PARAMETERS
from .episode import (
    LAYOUT_STREAM,
    Carry,
    Execution,
    OnCarry,
    RunningEpisode,
    StepReport,
    episode_rng,
    objects_in,
)
from .jaw_step import jaw_step
from .state import WorldState
from .tip_step import lead_down, tip_step

__all__: list[str] = []  # `warp_deform.worlds` is the import path of what is here

MOST_STARTS = 100
"""Starts that are drawn before a seed is given up; the tasks need 1 to 3."""
REST_LIMIT = 4.0
"""Longest wait for rest [s], after which a world that still moves is looked at as it is."""


class Worlds:
    """`count` episodes of a task.

        worlds = Worlds("cable-ring", 8)
        worlds.reset({slot: seed for slot, seed in enumerate(range(8))})
        reports = worlds.step({slot: action, ...})
        worlds.episodes[slot].snapshot.images.color

    Starts that already solve the task, or leave the table, are drawn again and counted.

    Args:
        robot: "ur5" or "panda"
        lanes: see `SolverFusedXPBD`
        precision: see `SolverFusedXPBD`
        bundles: see `SolverFusedXPBD`
        rest_limit: longest wait for rest after a path or a settling time [s]
    """

    def __init__(
        self,
        task: str | Task,
        count: int = 1,
        *,
        robot: str = "ur5",
        lanes: int | None = None,
        precision: str = "float32",
        rest_limit: float = REST_LIMIT,
        bundles: Path | None = None,
    ) -> None:
        self.task = task_of(task)
        self.precision, self.rest_limit = precision, rest_limit
        self.robot = find_robot(robot)
        if count < 1:
            raise InputError(f"count is {count}; there must be 1 world or more")
        self.count = count
        one = newton.ModelBuilder()
        SolverFusedXPBD.register_custom_attributes(one)
        self.objects: tuple[SceneObject, ...] = self.task.add_objects(one)
        builder = newton.ModelBuilder()
        SolverFusedXPBD.register_custom_attributes(builder)
        builder.replicate(one, count)
        self.model = builder.finalize(device="cpu")
        self.solver = SolverFusedXPBD(
            self.model, self.task.solver, lanes=lanes, precision=precision, bundles=bundles
        )
        self.episodes: dict[int, RunningEpisode] = {}
        self._scored: dict[int, tuple[Layout, Snapshot, float]] = {}
        self._topdown = TopDown()
        self._loop: ControlLoop | None = None
        self._space = FreeSpace(reach=self._reach())

    def _reach(self) -> tuple[float, float]:
        """Radii that the tip reaches at every height a task uses."""
        heights = [0.01, *(stage.lift for stage in self.task.stages)]
        radii = [self.robot.reach(z) for z in heights]
        return max(r[0] for r in radii), min(r[1] for r in radii)

    def _waiting_tip(self) -> np.ndarray:
        """Above the middle of the table (4,) x, y, z [m], yaw [rad]."""
        return np.array([0.5, 0.0, self.robot.hover_height(0.5, 0.0, self.task.primitive.hover), 0])

    def reset(self, seeds: Mapping[int, int], *, goals: Mapping[int, Goal] | None = None) -> None:
        """Start an episode with the given seed in every named slot.

        A goal-conditioned task gets the goal from `goals`, or constructs one from the seed.

        Raises:
            WarpDeformError: a seed gave no valid start.
        """
        for slot in seeds:
            self._check_slot(slot)
        self._end_control(seeds)
        goals = goals or {}
        rngs = {slot: episode_rng(seed, LAYOUT_STREAM) for slot, seed in seeds.items()}
        discarded, waiting = dict.fromkeys(seeds, 0), list(seeds)
        for _ in range(MOST_STARTS):
            if not waiting:
                return
            layouts = {s: self._sample(rngs[s], goals.get(s)) for s in waiting}
            made = {s: goals[s] for s in waiting if s in goals}
            if self.task.goal_conditioned:
                missing = {s: layouts[s] for s in waiting if s not in made}
                made |= self._construct_goals(missing, seeds)
                layouts = {
                    s: layouts[s] if s in goals else layouts[s].with_targets(goal.targets)
                    for s, goal in made.items()
                }
            self._start(layouts, seeds, made)
            again = []
            for s in waiting:
                episode = self.episodes[s]
                episode.discarded_starts, episode.goal_given = discarded[s], s in goals
                if s not in layouts or not self._acceptable(episode):
                    discarded[s] += 1
                    again.append(s)
            waiting = again
        if waiting:
            names = ", ".join(str(seeds[s]) for s in waiting)
            raise WarpDeformError(
                f"{self.task.name}: no valid start in {MOST_STARTS} draws for seed {names}"
            )

    def _sample(self, rng: np.random.Generator, goal: Goal | None) -> Layout:
        task, space = self.task, self._space
        return task.sample_for_goal(rng, space, goal.targets) if goal else task.sample(rng, space)

    def _check_slot(self, slot: int) -> None:
        if not 0 <= slot < self.count:
            raise InputError(f"slot {slot} is not one of the {self.count} worlds")

    def _start(
        self, layouts: Mapping[int, Layout], seeds: Mapping[int, int], goals: Mapping[int, Goal]
    ) -> None:
        """Place the objects, disturb them and let them settle."""
        data = self.solver.data
        for slot, layout in layouts.items():
            self._set_physics(slot, layout)
            if len(layout.particle_q):
                data.lane("particles.x", slot)[:] = layout.particle_q
                data.lane("particles.v", slot)[:] = 0.0
                data.wake(slot)
            objects = objects_in(layout, self.objects)
            if len(layout.body_q):
                data.set_bodies(slot, layout.body_q)
                self._shape_boxes(slot, layout, objects)
        least = {
            s: l.settle_seconds + max((push.seconds for push in l.pushes), default=0.0)
            for s, l in layouts.items()
        }
        results = rollout(
            self.solver,
            list(layouts),
            pushes={s: l.pushes for s, l in layouts.items()},
            min_seconds=least,
            max_seconds={s: seconds + self.rest_limit for s, seconds in least.items()},
            calm={s: l.settle_seconds if l.calm else 0.0 for s, l in layouts.items()},
        )
        for slot, layout in layouts.items():
            objects = objects_in(layout, self.objects)
            drawables = Drawables.of(self.task.drawn(layout, objects))
            limits = self.solver.config.limits
            self.episodes[slot] = RunningEpisode(
                seed=seeds[slot],
                layout=layout,
                objects=objects,
                drawables=drawables,
                goal=goals.get(slot),
                discarded_starts=0,
                sim_seconds=results[slot].seconds,
                problems=results[slot].watch.problems(slot, limits),
                at_rest=results[slot].at_rest,
                tip=self._waiting_tip(),
                posture=self.robot.home_q,
            )
            self.look(slot)

    def _shape_boxes(self, slot: int, layout: Layout, objects: tuple[SceneObject, ...]) -> None:
        """Give the boxes of a slot the sizes and masses that they have in its episode."""
        for item in (objects[i] for i in layout.configs):
            if isinstance(item, Box):
                size, inertia = item.config.parts[0].size, item.config.inertia()[1]
                self.solver.data.set_box(slot, item.body, np.array(size), item.config.mass, inertia)

    def _set_physics(self, slot: int, layout: Layout) -> None:
        """Give a slot the physics of its episode."""
        usual, own = self.task.solver, layout.physics
        self.solver.set_world(slot, **{n: own.get(n, getattr(usual, n)) for n in WORLD_PARAMETERS})

    def _construct_goals(
        self, layouts: Mapping[int, Layout], seeds: Mapping[int, int]
    ) -> dict[int, Goal]:
        """Goals with the objects placed at the sampled targets and settled; those to be trusted."""
        if not layouts:
            return {}
        self._start({s: self.task.goal_layout(l) for s, l in layouts.items()}, seeds, {})
        trusted = [s for s in layouts if self.episodes[s].physics_ok]
        return {s: self.as_goal(s, kind="constructed") for s in trusted}

    def as_goal(self, slot: int, *, kind: str) -> Goal:
        """The present state of a slot as a goal; `kind` is "constructed" or "demonstrated"."""
        snapshot = self.episodes[slot].snapshot
        targets = self.task.goal_targets(self.episodes[slot].layout, snapshot)
        images = snapshot.images
        return Goal(images.color, images.height, targets, kind, self.episodes[slot].seed)

    def _acceptable(self, episode: RunningEpisode) -> bool:
        """Whether a start is valid: trusted physics, everything on the table, not solved yet."""
        if not episode.physics_ok:
            return False
        points, ((x0, x1), (y0, y1)) = episode.snapshot.points, BOUNDS[:2]
        inside = (points >= (x0, y0)).all() and (points <= (x1, y1)).all()
        return bool(inside) and self.task.acceptable(episode.layout, episode.snapshot)

    def step(
        self,
        actions: Mapping[int, np.ndarray],
        *,
        record: float = 0.0,
        on_carry: OnCarry | None = None,
    ) -> dict[int, StepReport]:
        """Run one pick-and-place in every named slot and let the worlds come to rest.

        Args:
            actions: (7,) each, pick x, y [m], yaw [rad], place x, y, yaw, lift [m]; finite
            record: interval of recorded frames [s]; 0 records nothing.
            on_carry: called before tips carry, with reports of how they came; not for jaws
        """
        executions = {slot: self._checked(slot, action) for slot, action in actions.items()}
        if self.task.jaw is None:
            tip_step(self, executions, record, on_carry)
        else:
            jaw_step(self, executions, record)
        limits = self.solver.config.limits
        reports = {}
        for slot, execution in executions.items():
            episode = self.episodes[slot]
            for run in execution.runs:
                episode.sim_seconds += run.seconds
                episode.problems += run.watch.problems(slot, limits)
            outcome = execution.outcome if episode.physics_ok else Outcome.INVALID
            episode.history += (execution.past(outcome),)
            self.look(slot)
            episode.judge(self.task)
            reports[slot] = execution.report(outcome, recorded=record > 0)
        return reports

    def _checked(self, slot: int, action: np.ndarray) -> Execution:
        action = real_array(action, (7,), name=f"action of slot {slot}", finite=True)
        if slot not in self.episodes:
            raise InputError(f"slot {slot} has no episode: reset it first")
        if self.solver.continued[slot]:
            raise InputError(f"slot {slot} is under control: end it before a pick and place")
        self.episodes[slot].over |= self.episodes[slot].ended
        return Execution(action)

    def lead(self, actions: Mapping[int, np.ndarray]) -> dict[int, Carry]:
        """Move the tips of actions (7,) down to what they take: how they would carry it, by slot.

        Slots whose tip takes nothing, or cannot go there, are left out.
        """
        return lead_down(self, {slot: self._checked(slot, a) for slot, a in actions.items()})

    def control_loop(self, rate: float = 20.0) -> ControlLoop:
        """The loop that leads tips of slots at `rate` [Hz]; `TipControl` drives it.

        Raises:
            InputError: the rate has no whole number of substeps, or slots are under control at
                another one.
        """
        if self._loop is None or self._loop.rate != rate:
            if self._loop and len(self._loop.worlds):
                raise InputError(f"slots are under control at {self._loop.rate:g} Hz: end it first")
            self._loop = ControlLoop(self.solver, rate=rate)
        return self._loop

    def _end_control(self, slots: Iterable[int]) -> None:
        if self._loop and (busy := [slot for slot in slots if self.solver.continued[slot]]):
            self._loop.end(busy)

    def reachable(
        self, executions: Mapping[int, Execution], motions: Mapping[int, Motion]
    ) -> list[int]:
        """Slots whose motion the arm can make; notes motions, joints and what is out of reach."""
        postures = [self.episodes[slot].posture for slot in motions]
        joints = solve_joints(self.robot, list(motions.values()), postures)
        for (slot, motion), q in zip(motions.items(), joints, strict=True):
            executions[slot].motions.append(motion)
            executions[slot].joints.append(q)
            if q is None:
                executions[slot].outcome = Outcome.UNREACHABLE
            else:
                self.episodes[slot].posture = q[-1]
        return [slot for slot, q in zip(motions, joints, strict=True) if q is not None]

    def look(self, slot: int) -> None:
        """Take a snapshot of a slot's state."""
        data, episode = self.solver.data, self.episodes[slot]
        particle_q = np.array(data.lane("particles.x", slot), np.float32)
        particle_qd = np.array(data.lane("particles.v", slot), np.float32)
        body_q, body_qd = (each.astype(np.float32) for each in data.body_poses(slot))
        drawables, layout, topdown = episode.drawables, episode.layout, self._topdown
        ok = np.isfinite(particle_q).all() and np.isfinite(body_q).all()

        def render() -> Images:
            if not ok:
                raise WarpDeformError("a state that is not finite cannot be drawn")
            return self.task.draw(topdown, layout, drawables, particle_q, body_q)

        state = particle_q, particle_qd, body_q, body_qd
        past = episode.objects, episode.history, episode.over
        episode.snapshot = Snapshot(*state, drawables.segments, render, *past)

    def state(self, slot: int) -> WorldState:
        """All that the slot's episode goes on from; the slot must have been reset."""
        run = self._loop.save(slot) if self._loop and self.solver.continued[slot] else None
        return WorldState.of(self.solver.data, slot, self.episodes[slot], run)

    def restore(self, slot: int, state: WorldState) -> None:
        """Go on from `state` in a slot, bit for bit as where it was saved.

        It may come from another slot, or from other worlds of the same task, robot and precision.
        The slot is then under control if it was so where the state was saved, and holds the same.

        Raises:
            InputError: it does not fit.
        """
        self._check_slot(slot)
        if state.episode.posture.shape != self.robot.home_q.shape:
            raise InputError("the state was saved with another robot")
        self._end_control([slot])
        # before the state, for it wakes what sleeps
        self._set_physics(slot, state.episode.layout)
        episode = self.episodes[slot] = state.put(self.solver.data, slot)
        self._shape_boxes(slot, episode.layout, episode.objects)
        if state.run is not None:
            (self._loop or self.control_loop()).restore(slot, state.run)
        self.look(slot)

    def score(self, slot: int) -> float:
        """The task's score of a slot's state; 0 when the physics cannot be trusted."""
        episode = self.episodes[slot]
        if not episode.physics_ok:
            return 0.0
        now = episode.layout, episode.snapshot
        known = self._scored.get(slot)  # a step asks for it several times
        if known is None or known[0] is not now[0] or known[1] is not now[1]:
            known = self._scored[slot] = *now, self.task.score(*now)
        return known[2]

    def solved(self, slot: int) -> bool:
        """Whether a slot's task is done; never on an untrusted state."""
        episode = self.episodes[slot]
        if episode.physics_ok and type(self.task).solved is Task.solved:
            return self.score(slot) >= self.task.success_score
        return episode.physics_ok and self.task.solved(episode.layout, episode.snapshot)

    def enclosed(self, slot: int) -> bool | None:
        """Whether a slot's items are in a bag, never on an untrusted state; None without either."""
        episode = self.episodes[slot]
        enclosed = self.task.enclosed(episode.layout, episode.snapshot)
        return None if enclosed is None else enclosed and episode.physics_ok

    def hash(self, slot: int) -> str:
        """Hash of a slot's positions and velocities."""
        s = self.episodes[slot].snapshot
        return state_hash(s.particle_q, s.particle_qd, s.body_q, s.body_qd)
