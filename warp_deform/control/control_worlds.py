"""Episodes that are controlled at a fixed rate: what a step does, pays and ends."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np

from ..episodes import Goal
from ..errors import InputError, WarpDeformError
from ..objects.box import Box
from ..objects.cable import Cable
from ..objects.scene_object import SceneObject, box_of
from ..planning.demonstrators import demonstrator as find_demonstrator
from ..robots.primitive import Grasp
from ..support.checked import NOT_NEGATIVE, check_number
from ..support.quaternion import quat_from_yaw, quat_rotate
from ..tasks.task import Task
from ..worlds.acting import snapped
from ..worlds.episode import DEMONSTRATOR_STREAM, episode_rng
from ..worlds.loop import EpisodeRun
from ..worlds.rewards import Rewards
from ..worlds.tip_control import TipControl
from ..worlds.worlds import Worlds
from ..xpbd.config import SolverConfig
from .control_task import ControlTask, horizon_of
from .disturbed_starts import disturb
from .held_history import HeldHistory
from .limits import TipLimits
from .modes import CONTROL_MODES, ControlConfig, TipTargets
from .registry import control_task

__all__ = ["NOTHING", "SOLVED_STEPS", "ControlStep"]  # `warp_deform.control` has `ControlWorlds`

SOLVED_STEPS = 5
"""An episode has ended when it was solved for so many steps running."""
NOTHING = (None, None)
"""What a tip holds, a particle or a body, when it holds neither."""
_CABLE_SPEED, _CABLE_MARGIN = 8.0, 0.02
"""Speed clamp [m/s] and margin [m] of cables under control."""
_FREE_FLOOR = 0.001
"""Lowest height of a tip that holds nothing [m]: its radius."""
_DRAWS = 100
"""Plans to a goal that are drawn before a seed is given up."""
Start = Literal["free", "held"]
Release = Literal["rest", "moving"]


@dataclass(frozen=True)
class ControlStep:
    """What a control step did to one world."""

    reward: float
    terminated: bool
    truncated: bool
    success: bool


class ControlWorlds:
    """`count` episodes of a task whose tips are led at a fixed rate.

        worlds = ControlWorlds("cable-ring", 8)
        worlds.reset({slot: slot for slot in range(8)})
        done = worlds.step({slot: np.zeros(4) for slot in range(8)})

    An episode has the same bits alone and in any company. It ends when it was solved for 5 steps
    running, or when a guard fires; it is cut off after `horizon` steps.

    Args:
        task: a name, of `warp_deform.control.registry.CONTROL_TASKS` or of the benchmark, or a task
        control_mode: see `CONTROL_MODES`
        reward_mode: see `Rewards`
        start: "free", with the tip at its waiting place; "held", where the scripted demonstrator
            has taken what it would move first
        release: "rest", what is let go has no speed; "moving", it keeps the tip's
        config: rate and speeds; None: the task's
        horizon: control steps of an episode; None: the task's
        action_penalty: of |action - last action|^2, off the rewards "dense" and "normalized_dense"

    Raises:
        InputError: there is no such task, mode, start or release, or the task has a jaw.
    """

    def __init__(
        self,
        task: str | Task,
        count: int = 1,
        *,
        robot: str = "ur5",
        control_mode: str = "tip_delta_position",
        reward_mode: str = "dense",
        start: str = "free",
        release: str = "rest",
        config: ControlConfig | None = None,
        horizon: int | None = None,
        action_penalty: float = 0.01,
        lanes: int | None = None,
    ) -> None:
        found = control_task(task)
        for name, value, known in (
            ("start", start, get_args(Start)), ("release", release, get_args(Release)),
        ):  # fmt: skip
            if value not in known:
                raise InputError(f"{name} is one of {', '.join(known)}, not {value!r}")
        if horizon is not None and (type(horizon) is not int or horizon < 1):
            raise InputError(f"horizon is a number of control steps, 1 or more, not {horizon!r}")
        self.action_penalty = check_number(action_penalty, "action_penalty", NOT_NEGATIVE)
        own = found.control if isinstance(found, ControlTask) else ControlConfig()
        self.config = config or own
        self.horizon = horizon or horizon_of(found, self.config)
        if control_mode not in CONTROL_MODES:
            raise InputError(
                f"control_mode is one of {', '.join(CONTROL_MODES)}, not {control_mode!r}"
            )
        self.worlds = Worlds(found, count, robot=robot, lanes=lanes)
        self._usual = self.worlds.solver.config
        self._led_config = _for_control(self._usual, self.worlds.objects)
        self.limits = TipLimits(self.worlds.robot)
        self.targets = TipTargets(control_mode, self.config, self.limits, count)
        self.tips = TipControl(self.worlds, rate=self.config.rate)
        self.rewards = Rewards(self.worlds, reward_mode)
        self.start, self.release = start, release
        self.steps = np.zeros(count, int)
        """Control steps of every episode so far (W,)."""
        self._solved = np.zeros(count, int)
        self._last = np.zeros((count, self.targets.width))
        self._carried = [HeldHistory() for _ in range(count)]
        self.grips: list[tuple[int | None, int | None]] = [NOTHING] * count
        """The particle or body that every tip holds; None twice where it holds nothing."""

    @property
    def task(self) -> Task:
        """The task that is played."""
        return self.worlds.task

    def holding(self, slot: int) -> bool:
        """Whether the tip of a slot holds something."""
        return bool(self.tips.loop.holding([slot])[0])

    # -- starting

    def reset(self, seeds: Mapping[int, int], *, goals: Mapping[int, Goal] | None = None) -> None:
        """Start the episodes that the seeds name.

        Raises:
            WarpDeformError: a seed gave no valid start, nothing to hold, or no goal.
        """
        # starts are those of the seeds' picks and places, to the bit
        self.worlds.solver.config = self._usual
        self.worlds.reset(seeds, goals=goals)
        slots = list(seeds)
        if isinstance(self.task, ControlTask):
            disturb(self.worlds, self.task, slots)
            self._goals_by_plans(self.task, slots)
        grasps: Mapping[int, Grasp] = {}
        if self.start == "held" and self._held == NOTHING:
            grasps = self._scripted_grasps(slots)
        self._begin(slots, grasps)
        for slot in slots:
            self.begin_history(slot)
        self.rewards.start(slots)

    def begin_history(self, slot: int) -> None:
        """Forget what a slot's episode has done: it is where it began."""
        self._carried[slot] = HeldHistory()
        if self.holding(slot):
            self._note_taken(slot)
        self.steps[slot] = self._solved[slot] = 0
        self._last[slot] = 0.0

    @property
    def _held(self) -> tuple[int | None, int | None]:
        """The particle or body that the tip holds from the start."""
        if not isinstance(self.task, ControlTask):
            return NOTHING
        return self.task.held_particle, self.task.held_body

    @property
    def _ends_when_solved(self) -> bool:
        return not isinstance(self.task, ControlTask) or self.task.ends_when_solved

    def _begin(self, slots: Sequence[int], grasps: Mapping[int, Grasp]) -> None:
        """Take slots under control, with what they hold from the start."""
        self.worlds.solver.config = self._led_config
        self.tips.begin(slots)
        particle, body = self._held
        for slot in slots:
            episode, solver = self.worlds.episodes[slot], self.worlds.solver
            self.grips[slot] = particle, body
            if particle is not None:
                place = solver.particle_q(slot)[particle].astype(float)
                episode.tip = np.append(place, 0.0)
                self.tips.loop.hold(slot, particle=particle)
            elif body is not None:
                pose = solver.body_q(slot)[body].astype(float)
                episode.tip = np.append(pose[:3], 0.0)
                self.tips.loop.hold(slot, body=body, tip=pose[:3])
            elif slot in grasps:
                grasp, tip = grasps[slot], episode.tip
                self.grips[slot] = (grasp.particle, grasp.body)
                self.tips.loop.hold(
                    slot, particle=grasp.particle, body=grasp.body, tip=tip[:3],
                    rotation=quat_from_yaw(float(tip[3])),
                )  # fmt: skip
            self._set_floor(slot)
            self.targets.place([slot], np.array([episode.tip]))

    def _scripted_grasps(self, slots: Sequence[int]) -> dict[int, Grasp]:
        """Let the tips descend on what the scripted demonstrator would move first."""
        runs = {}
        for slot in slots:
            seed = self.worlds.episodes[slot].seed
            runs[slot] = EpisodeRun[Any](seed, episode_rng(seed, DEMONSTRATOR_STREAM))
        chosen = find_demonstrator("scripted")(self.worlds, runs)
        picks = {
            slot: snapped(action, self.task, self.worlds.episodes[slot].snapshot, np.inf)
            for slot, action in chosen.items()
            if action is not None
        }
        carries = self.worlds.lead(picks) if picks else {}
        for slot in slots:
            if slot not in carries:
                seed = self.worlds.episodes[slot].seed
                raise WarpDeformError(
                    f"{self.task.name}, seed {seed}: nothing could be taken hold of"
                )
        for slot in slots:
            # above the thing that it has met, with the pick's yaw
            self.worlds.episodes[slot].tip = np.array(
                [*picks[slot][:2], carries[slot].grasp.height, picks[slot][2]]
            )
        return {slot: carries[slot].grasp for slot in slots}

    def _goals_by_plans(self, task: ControlTask, slots: Sequence[int]) -> None:
        """Let plans draw the goals of a task that has them, then put everything back."""
        rngs = {
            slot: episode_rng(self.worlds.episodes[slot].seed, DEMONSTRATOR_STREAM)
            for slot in slots
        }
        before = {slot: self.worlds.state(slot) for slot in slots}
        waiting = list(slots)
        for _ in range(_DRAWS):
            plans = {
                slot: task.plan_for(self.worlds.episodes[slot].layout, rngs[slot])
                for slot in waiting
            }
            drawn = {slot: plan for slot, plan in plans.items() if plan is not None}
            if not drawn:
                return
            ends = self._ends_of(drawn)
            for slot in drawn:
                self.worlds.restore(slot, before[slot])
                episode = self.worlds.episodes[slot]
                if slot in ends and task.is_goal(ends[slot]):
                    episode.layout = task.layout_for(episode.layout, ends[slot])
                    waiting.remove(slot)
            if not waiting:
                return
        seeds = ", ".join(str(self.worlds.episodes[slot].seed) for slot in waiting)
        raise WarpDeformError(f"{task.name}: no goal in {_DRAWS} draws for seed {seeds}")

    def _ends_of(self, plans: Mapping[int, np.ndarray]) -> dict[int, np.ndarray]:
        """Particles (P, 3) [m] at the ends of plans, of those that no guard has ended."""
        slots = list(plans)
        self._begin(slots, {})
        targets = TipTargets("tip_delta_position", self.config, self.limits, self.worlds.count)
        targets.asked[:], targets.floors[:] = self.targets.asked, self.targets.floors
        fired: dict[int, Any] = {}
        for step in range(len(plans[slots[0]])):
            actions = np.array([np.append(plans[slot][step], 1.0) for slot in slots])
            knots = targets.follow(slots, actions)
            fired |= self.tips.loop.advance(knots[..., :3], worlds=slots)
        ends = {slot: self.worlds.solver.particle_q(slot) for slot in slots if slot not in fired}
        self.tips.loop.end(slots)
        return ends

    # -- going on

    def step(self, actions: Mapping[int, np.ndarray]) -> dict[int, ControlStep]:
        """Run one control step in every named slot.

        Args:
            actions: as the mode says, each number from -1 to 1; `ControlEnv` has checked them with
                `check_tip_action`, this does not
        """
        slots = list(actions)
        rows = np.array([actions[slot] for slot in slots], dtype=float)
        self.lead(slots, rows)
        for slot in slots:
            self.worlds.look(slot)
            self._carried[slot].follow(self.worlds.episodes[slot], self.task)
        return self._judged(slots, rows)

    def lead(self, slots: Sequence[int], rows: np.ndarray) -> None:
        """Run one control step without a look at what came of it: for searches.

        Args:
            rows: actions (n, width) of the slots
        """
        for slot, row in zip(slots, rows, strict=True):
            self._take_or_let_go(slot, bool(row[-1] > 0))
        knots = self.targets.follow(slots, rows)
        turns = quat_from_yaw(knots[..., 3])
        fired = self.tips.loop.advance(knots[..., :3], turns, worlds=slots)
        for slot, tip in zip(slots, knots[:, -1], strict=True):
            episode = self.worlds.episodes[slot]
            episode.tip = np.array(tip)
            episode.sim_seconds += self.tips.loop.seconds
            # these are of all control so far
            episode.problems = fired.get(slot, ()) or episode.problems
        self.steps[list(slots)] += 1

    def _judged(self, slots: list[int], rows: np.ndarray) -> dict[int, ControlStep]:
        rewards = self.rewards.take(slots)
        if self.rewards.mode in ("dense", "normalized_dense"):
            first = self.steps[slots] == 1
            change = np.where(first[:, None], 0.0, rows - self._last[slots])
            rewards = rewards - self.action_penalty * (change**2).sum(axis=1)
        self._last[slots] = rows
        ends = self._ends_when_solved
        done = {}
        for slot, reward in zip(slots, rewards, strict=True):
            success = bool(self.worlds.solved(slot))
            self._solved[slot] = self._solved[slot] + 1 if success else 0
            trusted = self.worlds.episodes[slot].physics_ok
            over = not trusted or (ends and self._solved[slot] >= SOLVED_STEPS)
            cut = not over and self.steps[slot] >= self.horizon
            done[slot] = ControlStep(
                float(reward) if trusted else 0.0, bool(over), bool(cut), success
            )
        return done

    def _take_or_let_go(self, slot: int, hold: bool) -> None:
        if isinstance(self.task, ControlTask) and self.task.keeps_hold:
            return
        holds = self.holding(slot)
        if hold and not holds:
            grasp = self.tips.hold(slot)
            if grasp is not None:
                self.grips[slot] = (grasp.particle, grasp.body)
                self._note_taken(slot)
                self._set_floor(slot)
        elif holds and not hold:
            self.tips.let_go(slot, release=self.release)
            self.grips[slot] = NOTHING
            self._carried[slot].let_go(self.worlds.episodes[slot])
            self._set_floor(slot)

    def _note_taken(self, slot: int) -> None:
        episode = self.worlds.episodes[slot]
        particle, body = self.grips[slot]
        self._carried[slot].take(episode, particle=particle, body=body)

    def _set_floor(self, slot: int) -> None:
        """How low the tip may go now: where what it holds lies on the table."""
        particle, body = self.grips[slot]
        episode, solver = self.worlds.episodes[slot], self.worlds.solver
        floor = _FREE_FLOOR
        if particle is not None:
            radius = float(solver.data.topologies[0].particle_radius[particle])
            floor = float(episode.tip[2] - solver.particle_q(slot)[particle, 2]) + radius
        elif body is not None:
            box = box_of(episode.objects, body)
            floor = float(episode.tip[2]) - _lowest(box, solver.body_q(slot)[body].astype(float))
        self.targets.floors[slot] = floor


def _for_control(config: SolverConfig, objects: Sequence[SceneObject]) -> SolverConfig:
    """The solver's parameters under control: beads at the end of a swing get to 6 m/s.

    The clamp at 3 m/s would act, and its guard fire, where nothing is wrong.
    """
    if not any(isinstance(item, Cable) for item in objects):
        return config
    faster = replace(
        config,
        max_speed=max(config.max_speed, _CABLE_SPEED),
        margin=max(config.margin, _CABLE_MARGIN),
    )
    return config if faster == config else faster


def _lowest(box: Box, pose: np.ndarray) -> float:
    """Height of the lowest corner of a body with this pose (7,) [m]."""
    signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    corners = [np.array(p.offset) + signs * np.array(p.size) / 2 for p in box.config.parts]
    return float((pose[:3] + quat_rotate(pose[3:], np.concatenate(corners)))[:, 2].min())
