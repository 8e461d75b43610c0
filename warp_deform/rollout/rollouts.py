"""Grip paths in, trajectories out: one launch runs many worlds until they rest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from ..objects.push import MOST_PUSHES, Push
from ..support.checked import NOT_NEGATIVE, Interval, check_number, real_array
from ..support.quaternion import quat_same_side
from ..xpbd.guards import WatchValues

if TYPE_CHECKING:
    from ..xpbd.fused_xpbd import FusedXPBD

__all__: list[str] = []  # `warp_deform.rollout` is the import path of what is here

_IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class GripPath:
    """A tip that holds one particle or body and lets it go at the end of its path.

    Attributes:
        times: of the knots (K,) [s], ascending from 0
        positions: of the tip (K, 3) [m]
        particle: local number of the particle that is held
        body: local number of the body that is held
        rotations: of the tip (K, 4) quat_xyzw
        offset: of what is held (a body: its centre of mass) in the tip's frame (3,) [m]
        turn: of what is held in the tip's frame (4,) quat_xyzw
        lower: between these two times [s] contact ends the descent, and the rest of the path stays
            there
    """

    times: np.ndarray
    positions: np.ndarray
    particle: int | None = None
    body: int | None = None
    rotations: np.ndarray | None = None
    offset: np.ndarray = field(default_factory=lambda: np.zeros(3))
    turn: np.ndarray = field(default_factory=lambda: _IDENTITY)
    lower: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if (self.particle is None) == (self.body is None):
            raise InputError("a grip path holds either a particle or a body")
        times = np.asarray(self.times, dtype=float)
        # a time that is not a number does not ascend
        if len(times) < 2 or times[0] != 0 or not (np.diff(times) >= 0).all():
            raise InputError("the times of a grip path must start at 0 and ascend, at least two")
        if np.shape(self.positions) != (len(times), 3) or not np.isfinite(self.positions).all():
            raise InputError(
                f"a path of {len(times)} knots needs finite positions ({len(times)}, 3)"
            )
        turns = self.rotations
        if turns is not None and (
            np.shape(turns) != (len(times), 4) or not np.isfinite(turns).all()
        ):
            raise InputError(
                f"a path of {len(times)} knots needs finite rotations ({len(times)}, 4)"
            )
        if self.lower is not None and not 0 <= self.lower[0] <= self.lower[1] <= times[-1]:
            raise InputError(f"lower is two ascending times within the path, not {self.lower}")


@dataclass(frozen=True, eq=False)
class Frames:
    """Recorded states of one world: times (F,) [s], particle_q (F, P, 3), body_q (F, B, 7)."""

    times: np.ndarray
    particle_q: np.ndarray
    body_q: np.ndarray


@dataclass(frozen=True, eq=False)
class Rollout:
    """What one launch did to one world."""

    seconds: float
    """Simulated time [s]."""
    watch: WatchValues
    at_rest: bool
    """Whether the world came to rest before its time was up."""
    frames: Frames | None


def rollout(
    solver: FusedXPBD,
    worlds: Sequence[int],
    *,
    paths: Mapping[int, GripPath] | None = None,
    pushes: Mapping[int, Sequence[Push]] | None = None,
    min_seconds: float | Mapping[int, float] = 0.0,
    max_seconds: float | Mapping[int, float] = 10.0,
    calm: float | Mapping[int, float] = 0.0,
    calm_after: float = 0.0,
    record: float = 0.0,
) -> dict[int, Rollout]:
    """Run `worlds` until each has followed its path and come to rest; others keep their state.

    Durations are rounded to whole substeps; `Rollout.seconds` and `Frames.times` are what was
    simulated.

    A world's result does not depend on which other worlds run with it.

    Args:
        paths: by world, what is held there and where it is led; nothing in the others
        pushes: by world, accelerations from the start on
        min_seconds: a world runs at least so long after its path [s]
        max_seconds: and at most so long in all [s]
        calm: speeds are clamped to `calm_speed` for so long from the start [s]
        calm_after: and for so long after a release [s]
        record: interval of recorded frames [s]; 0 records nothing
    """
    dt = solver.config.dt
    longest = prepare(
        solver,
        worlds,
        paths=paths,
        pushes=pushes,
        min_seconds=min_seconds,
        max_seconds=max_seconds,
        calm=calm,
        calm_after=calm_after,
    )
    every = max(1, _substeps(record, -1, "record", dt)) if record else 0
    watch = solver.run(longest, record_every=every)
    return {
        w: Rollout(
            seconds=watch[w].steps * dt,
            watch=watch[w],
            at_rest=watch[w].steps < _substeps(max_seconds, w, "max_seconds", dt),
            frames=_frames(solver, w, watch[w].steps, every),
        )
        for w in worlds
    }


def prepare(
    solver: FusedXPBD,
    worlds: Sequence[int],
    *,
    paths: Mapping[int, GripPath] | None = None,
    pushes: Mapping[int, Sequence[Push]] | None = None,
    min_seconds: float | Mapping[int, float] = 0.0,
    max_seconds: float | Mapping[int, float] = 10.0,
    calm: float | Mapping[int, float] = 0.0,
    calm_after: float = 0.0,
    dt: float | None = None,
) -> int:
    """Set a rollout up without running it, see `rollout`; returns its substeps at most.

    Args:
        dt: length of a substep [s]; None: the solver's
    """
    data, dt = solver.data, dt or solver.config.dt
    for w in worlds:
        if not 0 <= w < data.world_count:
            raise InputError(f"no world {w}: the solver has {data.world_count}")
    paths = paths or {}
    data.clear_grips()
    _write_paths(solver, paths)
    for w, kicks in (pushes or {}).items():
        _write_pushes(solver, w, kicks, dt)
    solver.activate(np.asarray(worlds, dtype=int))
    longest = 1
    for w in worlds:
        limit = _substeps(max_seconds, w, "max_seconds", dt)
        longest = max(longest, limit)
        data.per_world("group.least_steps", w)[:] = _substeps(min_seconds, w, "min_seconds", dt)
        data.per_world("group.most_steps", w)[:] = limit
        data.per_world("group.calm_steps", w)[:] = _substeps(calm, w, "calm", dt)
        data.per_world("group.calm_after", w)[:] = _substeps(calm_after, w, "calm_after", dt)
    return longest


def _substeps(value: float | Mapping[int, float], world: int, name: str, dt: float) -> int:
    """A duration [s] in substeps, the nearest whole number of them."""
    seconds = value[world] if isinstance(value, Mapping) else value
    return round(check_number(seconds, name, NOT_NEGATIVE) / dt)


def _write_pushes(solver: FusedXPBD, world: int, pushes: Sequence[Push], dt: float) -> None:
    data = solver.data
    if len(pushes) > MOST_PUSHES:
        raise InputError(
            f"{len(pushes)} pushes in world {world}; there may be {MOST_PUSHES} at once"
        )
    count = data.topologies[data.world_topology[world]].particle_count
    for at, push in enumerate(pushes, start=data.slot[world] * MOST_PUSHES):
        check_number(
            push.particle,
            f"Push.particle in world {world}",
            Interval(low=0, high=count - 1, whole=True),
        )
        steps = _substeps(push.seconds, world, "Push.seconds", dt)
        if steps == 0 and push.seconds > 0:
            raise InputError(
                f"Push.seconds is {push.seconds:.3g}, but a push takes one substep, {dt:.3g} s"
            )
        data.views["grips.push"][at] = push.particle
        data.views["grips.push_acceleration"][at] = real_array(
            push.acceleration, (3,), name="Push.acceleration", finite=True
        )
        data.views["grips.push_steps"][at] = steps


def _write_paths(solver: FusedXPBD, paths: Mapping[int, GripPath]) -> None:
    data = solver.data
    knots = sum(len(path.times) for path in paths.values())
    if knots > data.knot_room:
        data.reserve_knots(2 * knots)
        solver.forget_launch()
    views, k = data.views, 0
    for w, path in paths.items():
        slot, n = data.slot[w], len(path.times)
        topology = data.topologies[data.world_topology[w]]
        limit = topology.particle_count if path.particle is not None else topology.body_count
        held = path.particle if path.particle is not None else path.body
        if held is None or not 0 <= held < limit:
            raise InputError(f"world {w} has no particle or body number {held} to grip")
        views["grips.particle"][slot] = -1 if path.particle is None else path.particle
        views["grips.body"][slot] = -1 if path.body is None else path.body
        views["grips.offset"][slot] = path.offset
        views["grips.turn"][slot] = path.turn
        views["grips.tick"][slot] = 0
        views["grips.shift"][slot] = 0.0
        views["grips.knot"][slot] = k
        views["grips.knot_end"][slot] = k + n
        lower = path.lower or (0.0, 0.0)
        views["grips.lower_start"][slot], views["grips.lower_end"][slot] = lower
        views["grips.time"][k : k + n] = path.times
        views["grips.position"][k : k + n] = path.positions
        if path.particle is not None:
            data.tether(w, path.particle)
        rotations = _IDENTITY if path.rotations is None else quat_same_side(path.rotations)
        views["grips.rotation"][k : k + n] = rotations
        k += n


def _frames(solver: FusedXPBD, world: int, steps: int, every: int) -> Frames | None:
    if not every:
        return None
    data = solver.data
    count = -(-steps // every)
    group, lane = divmod(int(data.slot[world]), data.lanes)
    first, last = data.group_particle[group], data.group_particle[group + 1]
    total = int(data.group_particle[-1])
    if last > first:
        particles = data.views["watch.frame_x"][: count * total].reshape(count, total, 3, -1)
        particle_q = particles[:, first:last, :, lane].astype(np.float32)
    else:
        particle_q = np.zeros((count, 0, 3), np.float32)
    rows = data.body_rows(world)
    stride = int(data.group_body[-1])
    body_q = np.zeros((count, rows.stop - rows.start, 7), np.float32)
    if rows.stop > rows.start:
        x = data.views["watch.frame_body_x"][: count * stride].reshape(count, stride, 3)[:, rows]
        q = data.views["watch.frame_body_q"][: count * stride].reshape(count, stride, 4)[:, rows]
        com = data.topologies[data.world_topology[world]].body_com
        for f in range(count):
            body_q[f] = data.frame_poses(x[f], q[f], com)
    return Frames(np.arange(count) * every * solver.config.dt, particle_q, body_q)
