"""`ContinuedLaunch`: a launch of many substeps in parts, between which the host may decide."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ...errors import InputError
from ..config import FOREVER
from ..group_launch import GroupLaunch
from ..guards import Problem, WatchValues
from ..lanes.tape import STATE, RunColumn
from ..packing.data import KERNEL_ARGUMENTS
from ..packing.mirrored import Mirrored
from ..packing.topology import tethers
from ..springs.tether import NO_TETHER
from .guard_notes import GuardNotes
from .lane_runs import LaneRuns
from .lasting_grips import LastingGrips
from .near_lists import NearLists
from .selection import Selection, selection_of
from .world_run import WorldRun, lists_of, places_of

if TYPE_CHECKING:
    from ..fused_xpbd import FusedXPBD

__all__ = ["ContinuedLaunch"]

_OWN = ("near", "watch")
_OWN_OF_GROUPS = ("active", "calm_steps", "calm_after", "least_steps", "most_steps")


class ContinuedLaunch:
    """Worlds of a solver in launches that go on: part by part, to the bits of a single launch.

    A world goes on from `begin` to `end`. Between the parts it stays as the kernel left it: what is
    held is held, contact lists are not made anew, clocks and sleep run on, and the guards count as
    in one launch. Each world has a run of its own, so worlds may begin, take, let go and end while
    others of their group go on, and may pause.

    Contact lists, grips and what guards note have arrays of their own here, so other launches of
    the solver may run other worlds in between. Those that take part here are refused to them.

    Args:
        substeps: of every part
    """

    def __init__(self, solver: FusedXPBD, substeps: int) -> None:
        data = solver.data
        self.solver, self.data, self.substeps = solver, data, substeps
        self.dt = solver.config.dt
        self.grips = LastingGrips(data, self.dt)
        own = {
            name: array.like(1 if "frame" in name else None)  # nothing is filmed here
            for name, array in data.arrays.items()
            if name.partition(".")[0] in _OWN
        }
        own |= {n: data.arrays[n].like() for n in (f"group.{f}" for f in _OWN_OF_GROUPS)}
        own["particles.tether"] = data.arrays["particles.tether"].like()
        own["particles.tether"].view[:] = NO_TETHER
        for name in ("least_steps", "most_steps"):
            own[f"group.{name}"].view[:] = FOREVER
        self.arrays: dict[str, Mirrored] = own | self.grips.arrays
        self._runs = LaneRuns(data)
        self._control = self._runs.control
        self._near = NearLists(data, own, self._control["counters"])
        self._notes = GuardNotes(data, own)
        self._first_run = {name: mirrored.like() for name, mirrored in self._control.items()}
        self._config: Any = None
        self._launches: dict[bool, GroupLaunch] = {}
        self._group, self._lane = np.divmod(data.slot, data.lanes)
        self.open = np.zeros(data.world_count, bool)
        """Which worlds (W,) have begun and not ended."""
        self._launched = np.zeros(data.world_count, bool)
        """Worlds whose near pairs stand in the lists; those of others are parked."""
        self._selections: dict[tuple[int, ...] | None, Selection] = {}

    # -- worlds

    def begin(self, worlds: Sequence[int]) -> None:
        """Let worlds begin: they hold nothing, and what may touch is listed anew.

        Raises:
            InputError: one has begun already, or there is no such world.
        """
        worlds = self._known(worlds, begun=False)
        for w in worlds:
            self.grips.let_go(int(self.data.slot[w]))
        self._take_part(worlds)
        self._notes.clear(worlds)
        self._run_kernel(begins=True)
        state = self._first_run["state"].view.reshape(-1, STATE, self.data.lanes)
        self._runs.put(worlds, state[self._group[worlds], :, self._lane[worlds]])
        self._launched[worlds] = False
        self._near.parked |= {int(w): np.zeros(0, np.int32) for w in worlds}
        self._open(worlds, True)

    def end(self, worlds: Sequence[int] | np.ndarray) -> None:
        """Let worlds end: what they hold is let go at rest.

        Raises:
            InputError: one has not begun.
        """
        worlds = self._known(worlds, begun=True)
        for w in worlds:
            self._let_go(int(w), moving=False, calm=0)
            self._near.parked.pop(int(w), None)
        self._launched[worlds] = False
        self._open(worlds, False)

    def _known(self, worlds: Sequence[int] | np.ndarray, *, begun: bool) -> np.ndarray:
        names = [int(w) for w in worlds]
        if names and not (0 <= min(names) and max(names) < self.data.world_count):
            raise InputError(f"no worlds {names}: the solver has {self.data.world_count}")
        if len(set(names)) < len(names):
            raise InputError(f"a world is named twice in {names}")
        wrong = [w for w in names if self.open[w] != begun]
        if wrong:
            raise InputError(f"world {wrong[0]} has {'not begun' if begun else 'begun already'}")
        rows = np.array(names, dtype=int)
        if not begun and self.solver.continued[rows].any():
            raise InputError(f"worlds {rows.tolist()} are under another control")
        return rows

    def _open(self, worlds: np.ndarray, is_open: bool) -> None:
        self._selections = {}
        self.open[worlds] = self.solver.continued[worlds] = is_open

    # -- holding

    def hold(
        self,
        world: int,
        *,
        particle: int | None = None,
        body: int | None = None,
        position: np.ndarray,
        rotation: np.ndarray,
        offset: np.ndarray,
        turn: np.ndarray,
    ) -> None:
        """Hold a particle or a body from now on, with a tip that waits at `position`.

        Args:
            position: of the tip (3,) [m]
            rotation: of the tip (4,) quat_xyzw
            offset: of what is held in the tip's frame, as in `GripPath`
            turn: of what is held in the tip's frame, as in `GripPath`

        Raises:
            InputError: the world has not begun, holds something, or has no such particle or body.
        """
        self.check_holdable(world, particle, body)
        data, slot = self.data, int(self.data.slot[world])
        self.grips.hold(
            slot,
            particle=-1 if particle is None else particle,
            body=-1 if body is None else body,
            offset=offset,
            turn=turn,
            position=position,
            rotation=rotation,
        )
        if particle is not None:
            data.lane("particles.w", world)[particle] = 0.0
            top = data.topologies[data.world_topology[world]]
            self._tether(world)[:] = tethers(top, particle)
        else:
            data.views["bodies.w"][data.body_rows(world)][body] = 0.0
        self._runs.set(world, RunColumn.HOLDING, 1.0)
        self._selections = {}

    def check_holdable(self, world: int, particle: int | None, body: int | None) -> None:
        """Refuse to hold what cannot be held.

        Raises:
            InputError: the world has not begun, holds something, or has no such particle or body.
        """
        self._known([world], begun=True)
        if self.holding([world])[0]:
            raise InputError(f"world {world} holds something: let it go first")
        if (particle is None) == (body is None):
            raise InputError("hold either a particle or a body")
        top = self.data.topologies[self.data.world_topology[world]]
        held, count = (body, top.body_count) if particle is None else (particle, top.particle_count)
        if held is None or not 0 <= held < count:
            raise InputError(f"world {world} has no particle or body number {held} to hold")

    def let_go(self, world: int, *, moving: bool, calm: int = 0) -> None:
        """Let go of what a world holds, if anything.

        Args:
            moving: it keeps its velocity; otherwise it is at rest
            calm: speeds are clamped to `calm_speed` for so many substeps

        Raises:
            InputError: the world has not begun.
        """
        self._known([world], begun=True)
        self._let_go(world, moving=moving, calm=calm)

    def _let_go(self, world: int, *, moving: bool, calm: int) -> None:
        data, slot = self.data, int(self.data.slot[world])
        particle, body = self.held(world)
        if particle < 0 and body < 0:
            return
        if particle >= 0:
            data.lane("particles.w", world)[particle] = data.lane("particles.w0", world)[particle]
            if not moving:
                data.lane("particles.v", world)[particle] = 0.0
            self._tether(world)[:] = NO_TETHER
        else:
            row = data.body_rows(world).start + body
            data.views["bodies.w"][row] = data.views["bodies.w0"][row]
            if not moving:
                data.views["bodies.v"][row] = data.views["bodies.omega"][row] = 0.0
        self.grips.let_go(slot)
        self._runs.set(world, RunColumn.HOLDING, 0.0)
        self._runs.set(world, RunColumn.CALM, calm)
        self._selections = {}

    def holding(self, worlds: Sequence[int] | np.ndarray) -> np.ndarray:
        """Which of the worlds hold something (W,)."""
        return self.grips.holding(self.data.slot[worlds])

    def held(self, world: int) -> tuple[int, int]:
        """Numbers of the particle and of the body that a world holds, -1 for none."""
        return self.grips.held(int(self.data.slot[world]))

    def _tether(self, world: int) -> np.ndarray:
        return self.data.lane_of(self.arrays["particles.tether"], world)

    # -- running

    def select(self, worlds: Sequence[int] | np.ndarray | None = None) -> Selection:
        """How to run worlds (None: all that have begun, ascending), worked out once.

        Raises:
            InputError: one has not begun.
        """
        key = None if worlds is None else tuple(worlds)
        if key not in self._selections:
            rows = self._known(np.flatnonzero(self.open) if key is None else key, begun=True)
            held = np.flatnonzero(self.holding(rows))
            self._selections[key] = selection_of(self.data, rows, held)
        return self._selections[key]

    def advance(
        self,
        selection: Selection,
        positions: np.ndarray | None = None,
        rotations: np.ndarray | None = None,
    ) -> None:
        """Run the next part in the worlds of a selection; the others that have begun pause.

        Args:
            selection: what `select` gave since anything began, ended, was taken or let go
            positions: of the tips that hold something, in its order (S, K, 3) [m]; None:
                they wait
            rotations: (S, K, 4) quat_xyzw; None: they do not turn
        """
        worlds = selection.worlds
        self.check_room()
        if len(selection.slots):
            self.grips.append(selection.slots, self.substeps, positions, rotations)
        if not self._runs.launched_last(worlds):
            goes = np.zeros(self.data.world_count, bool)
            goes[worlds] = True
            for w in np.flatnonzero(goes != self._launched):
                if goes[w]:
                    self._near.unpark(int(w))
                elif self.open[w]:
                    self._near.park(int(w))
            self._launched = goes
            self._take_part(worlds)
        self._runs.enter(worlds)
        try:
            self._run_kernel(begins=False)
        except InputError:
            self.grips.cut(selection.slots)
            raise

    def check_room(self) -> None:
        """Refuse another part for which there is no memory; here it takes none."""

    def _take_part(self, worlds: np.ndarray) -> None:
        active = self.arrays["group.active"].view
        active[:] = 0.0
        active[self._group[worlds], self._lane[worlds]] = 1.0

    def _run_kernel(self, *, begins: bool) -> None:
        launch = self._launch(begins)
        self._to_device()
        launch.launch(0 if begins else self.substeps)
        self._to_host()

    def _own(self) -> tuple[Mirrored, ...]:
        return (*self.arrays.values(), *self._control.values(), *self._first_run.values())

    def _to_device(self) -> None:
        if not self.data.device.is_cpu:
            self.data.to_device()
            for mirrored in self._own():
                mirrored.to_device()

    def _to_host(self) -> None:
        if not self.data.device.is_cpu:
            self.data.to_host()
            for mirrored in self._own():
                mirrored.to_host()

    def _launch(self, begins: bool) -> GroupLaunch:
        """The recorded launch of a part, or of none, in which worlds begin."""
        solver, data = self.solver, self.data
        if self._config is not solver.config:
            if solver.config.dt != self.dt:
                raise InputError("the substep of a launch that goes on cannot change: end it first")
            self._config, self._launches = solver.config, {}
            structs = data.structs(self.arrays)
            for first in (True, False):
                tape = data.types.Tape()
                tape.part, tape.resume, tape.last = 1, int(not first), 0
                control = self._first_run if first else self._control
                tape.state, tape.counters = control["state"].array, control["counters"].array
                structs[KERNEL_ARGUMENTS.index("tape")] = tape
                inputs = [self.settings(0 if first else self.substeps), *structs]
                self._launches[first] = solver.group_launch(solver._kernel, inputs)
        return self._launches[begins]

    def settings(self, substeps: int) -> Any:
        """The kernel's settings for so many substeps."""
        every = self.solver.damp_every(self.substeps, dt=self.dt)
        return self.solver._new_settings(self.solver.config, substeps, 0, self.dt, every)

    def particles(self, name: str, worlds: Sequence[int] | None) -> np.ndarray:
        """Positions "x" or velocities "v" (W, P, 3) of worlds of one topology, see `select`."""
        scalars = self.select(worlds).scalars
        if scalars is None:
            raise InputError("no world is under control: call begin() first")
        return self.data.views[f"particles.{name}"].reshape(-1).take(scalars)

    # -- guards

    def problems(self, worlds: np.ndarray) -> dict[int, tuple[Problem, ...]]:
        """Guards that have fired in the worlds since each has begun, of those where one has."""
        return self._notes.problems(worlds, self.solver.config.limits, self._runs)

    def watch(self, world: int) -> WatchValues:
        """What the guards have noted of a world since it has begun, as in one launch."""
        return self._notes.values(world, self._runs)

    # -- saving

    def save(self, world: int) -> WorldRun:
        """What a world that has begun goes on from, besides positions and velocities.

        Raises:
            InputError: it has not begun.
        """
        self._known([world], begun=True)
        places = places_of(self.data, self.arrays, world)
        lists = lists_of(self.data, world)
        return WorldRun(
            run=self._runs.rows(np.array([world]))[0],
            pairs=self._near.pairs(world),
            arrays={name: place.copy() for name, place in (places | lists).items()},
            grip=self.grips.save(int(self.data.slot[world])),
        )

    def restore(self, world: int, saved: WorldRun) -> None:
        """Let a world that has not begun go on from what `save` gave, of this or another world.

        Raises:
            InputError: it has begun, or what was saved is of another scene or precision.
        """
        (w,) = self._known([world], begun=False)
        places = places_of(self.data, self.arrays, world)
        for name, place in places.items():
            values = saved.arrays.get(name)
            if values is None or (values.shape, values.dtype) != (place.shape, place.dtype):
                raise InputError("a saved run does not fit this world: it is of another scene")
        for name, place in places.items():
            place[...] = saved.arrays[name]
        for name, rows in lists_of(self.data, world).items():
            rows[...] = saved.arrays[name]
        self.grips.restore(int(self.data.slot[w]), saved.grip)
        self._runs.put(np.array([w]), saved.run[None])
        self._launched[w] = False
        self._near.parked[int(w)] = saved.pairs
        self._open(np.array([w]), True)
