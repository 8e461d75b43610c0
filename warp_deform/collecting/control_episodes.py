"""Episodes of control at a fixed rate, played from many seeds side by side and told as records."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..control.control_task import ControlTask
from ..control.control_worlds import ControlWorlds
from ..control.modes import CONTROL_MODES, ControlConfig
from ..control.numbers import control_numbers
from ..episodes import (
    CONTROL,
    CONTROL_FORMAT,
    ControlRecord,
    ControlRow,
    Episode,
    Step,
)
from ..tasks.task import Task
from ..worlds.loop import SLOTS, SOLVED, reset_each
from .recording import episode_info, observe, origin

__all__ = [
    "ControlEpisode",
    "ControlSetup",
    "control_worlds",
    "observed",
    "play_control_episodes",
    "record_control",
    "without_idle_end",
]

Act = Callable[[Mapping[int, "ControlEpisode"]], Mapping[int, np.ndarray | None]]
"""Next action (A,) of every running slot, or None for a slot whose episode is to end."""


@dataclass(frozen=True)
class ControlSetup:
    """A task and how its tips are led: what makes `ControlWorlds`.

    Attributes:
        task: its class
        config: rate and speeds; None: the task's
        horizon: control steps of an episode; None: the task's
    """

    task: type[Task]
    robot: str = "ur5"
    control_mode: str = "tip_delta_position"
    start: str = "free"
    release: str = "rest"
    reward_mode: str = "dense"
    config: ControlConfig | None = None
    horizon: int | None = None

    @staticmethod
    def of(task: Task, robot: str, record: ControlRecord) -> ControlSetup:
        """That of a recorded episode."""
        config = ControlConfig(
            rate=record.rate, max_speed=record.max_speed, max_turn=record.max_turn
        )
        return ControlSetup(
            type(task), robot, record.mode, record.start, record.release, record.reward_mode,
            config, record.horizon,
        )  # fmt: skip


@functools.lru_cache(maxsize=2)
def control_worlds(how: ControlSetup) -> ControlWorlds:
    """This process's worlds of a task that is led so, built once and used again."""
    return ControlWorlds(
        how.task(), SLOTS, robot=how.robot, control_mode=how.control_mode,
        reward_mode=how.reward_mode, start=how.start, release=how.release, config=how.config,
        horizon=how.horizon, lanes=SLOTS,
    )  # fmt: skip


@dataclass(eq=False)
class ControlEpisode:
    """One episode as it goes.

    Attributes:
        rows: at the start and after every control step
        actions: (A,) float64 each
        ended: why the episode is over, None while it runs
    """

    seed: int
    rows: list[Step] = field(default_factory=list)
    actions: list[np.ndarray] = field(default_factory=list)
    ended: str | None = None


def play_control_episodes(
    control: ControlWorlds,
    seeds: Iterable[int],
    *,
    start: Callable[[Mapping[int, ControlEpisode]], None],
    act: Act,
    pictures: bool = False,
    to_the_end: bool = False,
) -> Iterator[tuple[int, ControlEpisode]]:
    """Play the episodes of `seeds` and yield each, with its slot, the moment it is over.

    A slot whose episode is over gets the next seed. Neither the order of the seeds nor the company
    changes an episode.

    Args:
        start: called with the episodes that were just reset, by slot
        pictures: whether rows have them
        to_the_end: episodes end when `act` says so, and by no other rule
    """
    waiting = iter(seeds)
    free = list(range(control.worlds.count))
    running: dict[int, ControlEpisode] = {}
    while True:
        # zip asks `free` first, so no seed is lost when the slots run out
        new = {slot: ControlEpisode(seed) for slot, seed in zip(free, waiting, strict=False)}
        free = free[len(new) :]
        reset_each(new, control.reset)
        running |= new
        if not running:
            return
        begun = {slot: run for slot, run in new.items() if run.ended is None}
        for slot, run in begun.items():
            run.rows.append(_row(control, slot, 0.0, pictures))
        start(begun)
        live = {slot: run for slot, run in running.items() if run.ended is None}
        chosen: dict[int, np.ndarray] = {}
        for slot, action in act(live).items():
            if action is None:
                live[slot].ended = "nothing to do"
            else:
                chosen[slot] = np.array(action, dtype=float)
        done = control.step(chosen) if chosen else {}
        for slot, step in done.items():
            run = running[slot]
            run.actions.append(chosen[slot])
            episode = control.worlds.episodes[slot]
            if not episode.physics_ok:
                run.ended = "physics: " + "; ".join(map(str, episode.problems))
                continue
            run.rows.append(_row(control, slot, step.reward, pictures))
            if (step.terminated or step.truncated) and not to_the_end:
                run.ended = SOLVED if step.success else f"not solved in {len(run.actions)} steps"
        for slot in [slot for slot, run in running.items() if run.ended is not None]:
            free.append(slot)
            yield slot, running.pop(slot)


def _row(control: ControlWorlds, slot: int, reward: float, pictures: bool) -> Step:
    """The row of a slot's present state, without heights; `record_control` fills in the action."""
    tip = np.array(control.worlds.episodes[slot].tip, dtype=float)
    return replace(
        observe(control.worlds, slot, images=pictures),
        height=np.zeros((0, 0), np.float32),
        control=ControlRow(tip, control.holding(slot), float(reward)),
    )


def observed(control: ControlWorlds, slot: int, run: ControlEpisode) -> np.ndarray:
    """The observation "state" (D,) float32 of a slot, as environments show it."""
    episode, tip = control.worlds.episodes[slot], run.rows[-1].control
    assert tip is not None, "rows of control have a tip"
    numbers = control_numbers(
        tip=tip.tip,
        holding=tip.holding,
        particle_q=episode.snapshot.particle_q,
        particle_qd=episode.snapshot.particle_qd,
        body_q=episode.snapshot.body_q,
        goal=np.asarray(episode.layout.targets, dtype=float),
        time=len(run.actions) / control.horizon,
    )
    return np.concatenate([np.asarray(array, np.float32).ravel() for array in numbers.values()])


def without_idle_end(run: ControlEpisode) -> ControlEpisode:
    """The episode without the control steps at its end in which the tip was told nothing.

    What was learnt from them is to stand still. None may be cut at the beginning: the simulation
    goes on in them, so the actions that follow would lead to other states.
    """
    last = len(run.actions)
    while last > 1 and run.rows[last - 1].success and _idle(run.actions, last - 1):
        last -= 1
    return replace(run, rows=run.rows[: last + 1], actions=run.actions[:last])


def _idle(actions: Sequence[np.ndarray], t: int) -> bool:
    """Whether action t moves nothing and neither takes nor lets go."""
    same = t > 0 and (actions[t][-1] > 0) == (actions[t - 1][-1] > 0)
    return same and not actions[t][:-1].any()


def record_control(
    control: ControlWorlds, slot: int, run: ControlEpisode, *, demonstrator: str, pictures: bool
) -> Episode:
    """The episode that has just ended in a slot."""
    worlds = control.worlds
    episode, last = worlds.episodes[slot], run.rows[-1]
    rows = [
        replace(row, action=action, outcome="led")
        for row, action in zip(run.rows, run.actions, strict=False)
    ]
    targets = np.asarray(episode.layout.targets, dtype=float)
    how = ControlRecord(
        names=CONTROL_MODES[control.targets.mode],
        mode=control.targets.mode,
        start=control.start,
        release=control.release,
        rate=float(control.config.rate),
        max_speed=float(control.config.max_speed),
        max_turn=float(control.config.max_turn),
        horizon=int(control.horizon),
        reward_mode=control.rewards.mode,
        instruction=worlds.task.instruction,
        targets=tuple(targets.ravel().tolist()),
        shape=targets.shape,
        pictures=pictures,
    )
    named = {} if isinstance(worlds.task, ControlTask) else origin(worlds.task)
    info = episode_info(
        worlds,
        slot,
        run,
        demonstrator=demonstrator,
        sim_seconds=last.sim_seconds,
        extra={**named, CONTROL: how.as_json()},
        format=CONTROL_FORMAT,
    )
    goal = episode.goal
    if goal is not None:
        color = goal.color if pictures else np.zeros((0, 0, 3), np.uint8)
        goal = replace(goal, color=color, height=np.zeros((0, 0), np.float32))
    return Episode(info, (*rows, last), goal)
