"""States drawn from the scripted demonstrator's episodes, with what is left of the grip's path."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from ..rollout.rollouts import GripPath, rollout
from ..tasks.task import Action
from ..worlds.episode import DEMONSTRATOR_STREAM, episode_rng
from ..worlds.state import WorldState
from ..worlds.worlds import Worlds

__all__ = ["Draw", "Start", "actions_of_episodes", "draw_states", "touching_of"]

ACTIONS = 4
"""Actions of an episode that states are drawn from; then comes the next seed."""
MOST_EACH = 10
"""States of one action at most."""
AFTER = 0.5
"""States are drawn until so long after a release [s]."""
RELEASES = 0.3
"""Share of states drawn just before the release; a descent that contact ends early is past it."""
LANDINGS = 0.15
"""Share of states drawn from the lowering and the dwell before the release."""


@dataclass(frozen=True, eq=False)
class Start:
    """An action of an episode: the state before it, and when the tip has taken something."""

    before: WorldState
    taken: WorldState
    action: Action
    path: GripPath


@dataclass(frozen=True, eq=False)
class Draw:
    """A state in the middle of an action, and the path from there; None: let go already.

    Attributes:
        touching: (B,), how many things each body met in the substep before, which may end a descent
    """

    state: WorldState
    path: GripPath | None
    touching: np.ndarray


def actions_of_episodes(worlds: Worlds, seed: int) -> Iterator[Start]:
    """Actions that move something, of episodes from `seed` on, played in world 0."""
    task, tries = worlds.task, 0
    while True:
        worlds.reset({0: seed})
        rng = episode_rng(seed, DEMONSTRATOR_STREAM)
        for _ in range(ACTIONS):
            episode, before = worlds.episodes[0], worlds.state(0)
            action = task.demonstrate(episode.layout, episode.snapshot, rng)
            if action is None:
                break
            carry = worlds.lead({0: action}).get(0)
            if carry is not None:
                tries = 0
                yield Start(before, worlds.state(0), action, carry(action)[1])
            worlds.restore(0, before)
            worlds.step({0: action})
            if worlds.solved(0) or not worlds.episodes[0].physics_ok:
                break
        seed, tries = seed + 1, tries + 1
        if tries > 100:
            return


def draw_states(
    worlds: Worlds, rng: np.random.Generator, *, seed: int, each: int = MOST_EACH
) -> Iterator[Draw]:
    """States without end, `each` of an action: most at any time of it, others around landing and
    release.

    Between two of them the caller may use the worlds.
    """
    each = min(worlds.count, MOST_EACH, each)
    for start in actions_of_episodes(worlds, seed):
        times = [_time(start.path, rng, worlds.solver.config.dt) for _ in range(each)]
        before = worlds.state(0)
        for slot in range(each):
            worlds.restore(slot, start.taken)
        rollout(
            worlds.solver,
            range(each),
            paths=dict.fromkeys(range(each), start.path),
            min_seconds=1e3,
            max_seconds=dict(enumerate(times)),
        )
        states = [worlds.state(slot) for slot in range(each)]
        met = [touching_of(worlds, slot).copy() for slot in range(each)]
        for state, time, touching in zip(states, times, met, strict=True):
            yield Draw(state, _rest_of(start.path, time, state), touching)
        worlds.restore(0, before)


def touching_of(worlds: Worlds, slot: int) -> np.ndarray:
    """`Draw.touching` as a slot has it; to be written to, for it outlasts a launch."""
    data = worlds.solver.data
    met: np.ndarray = data.views["bodies.touching"][data.body_rows(slot)]
    return met


def _time(path: GripPath, rng: np.random.Generator, dt: float) -> float:
    """When on its path an action is stopped [s]; whole substeps, one at least."""
    kind, end = rng.random(), float(path.times[-1])
    if kind < RELEASES:
        time = end - 0.5 * dt
    elif kind < RELEASES + LANDINGS:
        time = rng.uniform(path.lower[0] if path.lower else 0.8 * end, end)
    else:
        time = rng.uniform(0.0, end + AFTER)
    return max(1, int(time / dt)) * dt


def _rest_of(path: GripPath, time: float, state: WorldState) -> GripPath | None:
    """The path from `time` on, moved to where the held thing is: contact may have ended the descent
    before.
    """
    later = path.times > time
    if not later.any():
        return None

    def at(values: np.ndarray) -> np.ndarray:
        columns = [np.interp(time, path.times, column) for column in values.T]
        return np.vstack([columns, values[later]])

    positions = at(path.positions)
    rotations = None if path.rotations is None else at(np.asarray(path.rotations))
    turn = Rotation.from_quat([0.0, 0.0, 0.0, 1.0] if rotations is None else rotations[0])
    held = state.body_x[path.body] if path.particle is None else state.particle_q[path.particle]
    positions += held - turn.apply(path.offset) - positions[0]
    lower = None
    if path.lower is not None and path.lower[1] > time:
        lower = (max(path.lower[0] - time, 0.0), path.lower[1] - time)
    times = np.array([0.0, *(path.times[later] - time)])
    return replace(path, times=times, positions=positions, rotations=rotations, lower=lower)
