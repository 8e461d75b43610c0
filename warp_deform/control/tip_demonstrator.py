"""Picks and places of the scripted demonstrators, led as control steps through the action space."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ..errors import InputError
from ..objects.scene_object import is_surface
from ..planning.demonstrators import demonstrator
from ..robots.primitive import Grasp, Motion, PrimitiveConfig, Stage, approach, carry, find_grasp
from ..support.quaternion import quat_from_yaw
from ..tasks.task import Task
from ..worlds.acting import snapped
from ..worlds.episode import DEMONSTRATOR_STREAM, episode_rng
from ..worlds.loop import Act, EpisodeRun
from .control_worlds import ControlWorlds

__all__ = ["TIP_MODES", "TipDemonstrator", "usual_mode"]

TIP_MODES = ("tip_delta_position", "tip_delta_pose")
"""Control modes in which a demonstrator leads a tip."""
_TRAVEL = 0.10
"""Height at which an empty tip goes from place to place [m]. It meets nothing."""
_RISE = 0.4
"""Speed of the first 10 cm after a release [m/s]: solved steps are seen with a tip that moves."""
_DWELL = 0.1
"""Wait between lowering and letting go [s]."""
_STEP = 1e-6
"""Of a control step, that a stretch may be longer than a whole number of them."""


def usual_mode(task: Task) -> str:
    """The control mode in which a task is demonstrated, unless another one is asked for."""
    return TIP_MODES[task.place_yaws > 1]


@dataclass(frozen=True)
class _Target:
    """Where the tip is to be after a step (4,), x, y, z [m], yaw [rad], and whether it holds."""

    pose: np.ndarray
    hold: bool


@dataclass(eq=False)
class _Guidance:
    """One episode: whose turn it is, and what the tip still has to do."""

    run: EpisodeRun[Any]
    action: np.ndarray | None = None
    """The pick and place that is under way (7,)."""
    targets: list[_Target] = field(default_factory=list)
    loaded: bool = False
    """Whether the targets are those of a tip that has taken something."""


class TipDemonstrator:
    """What a task's demonstrator would pick and place, as actions of control worlds.

        demonstrator = TipDemonstrator(worlds)
        worlds.reset({0: 5})
        demonstrator.start([0])
        while (action := demonstrator.act([0])[0]) is not None:
            worlds.step({0: action})

    The tip goes above the pick point, descends, takes, lifts, carries, lowers, lets go and rises,
    along the straight lines and at the speeds of `carry`, each stretch in whole control steps.
    Actions are numbers of float32, so that data sets of that precision repeat them.

    Args:
        name: "scripted" or "visible", see `warp_deform.planning.demonstrators`; or who says what to
            pick and place next, as those do

    Raises:
        InputError: the mode of the worlds is none of `TIP_MODES`.
    """

    def __init__(self, control: ControlWorlds, name: str | Act[Any] = "scripted") -> None:
        if control.targets.mode not in TIP_MODES:
            raise InputError(
                f"demonstrations are made in {' or '.join(TIP_MODES)}, not {control.targets.mode!r}"
            )
        self._control = control
        self._act = demonstrator(name) if isinstance(name, str) else name
        speed, turn = control.config.max_speed, control.config.max_turn
        primitive = control.task.primitive
        self._primitive: PrimitiveConfig = replace(
            primitive,
            unloaded_speed=min(primitive.unloaded_speed, speed),
            turn_speed=min(primitive.turn_speed, turn) if self._turns else 1e6,
            dwell=_DWELL,
        )
        self._guidance: dict[int, _Guidance] = {}

    @property
    def _turns(self) -> bool:
        return self._control.targets.mode == "tip_delta_pose"

    def start(self, slots: Sequence[int]) -> None:
        """Begin with slots that were just reset."""
        for slot in slots:
            seed = self._control.worlds.episodes[slot].seed
            self._guidance[slot] = _Guidance(
                EpisodeRun(seed, episode_rng(seed, DEMONSTRATOR_STREAM))
            )

    def act(self, slots: Sequence[int]) -> dict[int, np.ndarray | None]:
        """Next actions (A,) float32 by slot; None where the demonstrator sees nothing to do."""
        return {slot: self._next(slot) for slot in slots}

    def _next(self, slot: int) -> np.ndarray | None:
        guidance = self._guidance[slot]
        holds = self._control.holding(slot)
        if holds and not guidance.loaded:
            self._carry(slot, guidance)
        elif guidance.loaded and not holds and guidance.targets and guidance.targets[0].hold:
            guidance.targets, guidance.loaded = [], False  # it lost what it had
        if not guidance.targets and not self._approach(slot, guidance):
            return None
        target = guidance.targets.pop(0)
        if guidance.loaded and not target.hold:
            guidance.loaded = False
        return self._towards(slot, target)

    def _approach(self, slot: int, guidance: _Guidance) -> bool:
        """Plan the way to the next pick; False: there is none."""
        worlds = self._control.worlds
        chosen = self._act(worlds, {slot: guidance.run})[slot]
        if chosen is None:
            return False
        episode = worlds.episodes[slot]
        action = snapped(chosen, self._control.task, episode.snapshot, np.inf)
        guidance.action, guidance.loaded = action, False
        tip = self._asked(slot)
        q, bodies = episode.snapshot.particle_q, episode.snapshot.body_q
        grasp = find_grasp(action[:3], episode.objects, q, bodies, self._primitive)
        if grasp is None:
            return False
        motion = approach(tip, action[:3], _TRAVEL, grasp.height, self._primitive)
        guidance.targets = self._steps(motion, hold=False)
        # it takes at the beginning of a step, so with the take it already rises
        up = min(self._stage(action).speed, self._control.config.max_speed)
        rise = up * self._control.config.seconds
        guidance.targets.append(
            _Target(guidance.targets[-1].pose + np.array([0, 0, rise, 0]), hold=True)
        )
        return True

    def _carry(self, slot: int, guidance: _Guidance) -> None:
        """Plan how what was just taken is carried, lowered and let go."""
        asked = self._asked(slot)
        if guidance.action is None:  # it was held from the start
            chosen = self._act(self._control.worlds, {slot: guidance.run})[slot]
            if chosen is None:
                return
            guidance.action = chosen
        action = np.concatenate([asked[[0, 1, 3]], guidance.action[3:]])
        stage, floor = self._stage(action), float(self._control.targets.floors[slot])
        particle, body = self._control.grips[slot]
        objects = self._control.worlds.episodes[slot].objects
        grasp = Grasp(
            float(asked[2]), np.zeros(3), quat_from_yaw(0.0), particle, body,
            sheet=particle is not None and is_surface(objects, particle),
        )  # fmt: skip
        motion, _ = carry(action, grasp, stage, floor, _TRAVEL, self._primitive)
        loaded = Motion(motion.times[:-1], motion.waypoints[:-1])
        guidance.targets = self._steps(loaded, hold=True)
        bottom = loaded.waypoints[-1]
        above = bottom + np.array([0, 0, _TRAVEL, 0])
        way = Motion(np.array([0.0, _TRAVEL / _RISE]), np.stack([bottom, above]))
        guidance.targets += self._steps(way, hold=False)
        guidance.loaded = True

    def _stage(self, action: np.ndarray) -> Stage:
        stage = self._control.task.stage_of(float(action[6]))
        most = self._control.config.max_speed
        lower = None if stage.lower_speed is None else min(stage.lower_speed, most)
        return replace(stage, speed=min(stage.speed, most), lower_speed=lower)

    def _asked(self, slot: int) -> np.ndarray:
        """The last target (4,), to which actions add."""
        return np.array(self._control.targets.asked[slot])

    def _steps(self, motion: Motion, *, hold: bool) -> list[_Target]:
        """Targets along a motion, a whole number of control steps for every stretch."""
        targets = []
        for k in range(len(motion.times) - 1):
            seconds = float(motion.times[k + 1] - motion.times[k])
            count = int(np.ceil(seconds / self._control.config.seconds - _STEP))
            a, b = motion.waypoints[k], motion.waypoints[k + 1]
            targets += [_Target(a + (b - a) * (i / count), hold) for i in range(1, count + 1)]
        return targets

    def _towards(self, slot: int, target: _Target) -> np.ndarray:
        """The action (A,) that adds what is missing from the last target, as far as it may."""
        config = self._control.config
        way = target.pose - self._asked(slot)
        move = way[:3] / (config.max_speed * config.seconds)
        move = move / max(1.0, float(np.linalg.norm(move)))
        turn = np.clip(way[3:] / (config.max_turn * config.seconds), -1, 1)
        numbers = [*move, *(turn if self._turns else ()), 1.0 if target.hold else -1.0]
        return np.clip(np.array(numbers, np.float32), -1, 1)
