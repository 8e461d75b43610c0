"""`FusedXPBD`: the worlds of a Newton model in SIMD lanes, and launches that run many substeps.

What rollouts, recordings and `SolverFusedXPBD` stand on; it knows Newton's model, but neither its
states nor its steps.
"""

from __future__ import annotations

import functools
import math
from pathlib import Path
from typing import Any

import newton
import numpy as np
import warp as wp

from ..errors import InputError
from ..support.checked import COUNT, NOT_NEGATIVE, POSITIVE, check_number
from ..support.threads import default_threads
from .bundle import write_bundle
from .config import FOREVER, WORLD_PARAMETERS, SolverConfig
from .group_launch import GroupLaunch
from .guards import PhysicsError, Problem, WatchValues
from .kernels.forward import forward_kernel
from .packing.data import WATCHED, SolverData
from .packing.topology import greatest_loss, pieces
from .springs.viscosity import DAMP_EVERY

__all__ = ["FusedXPBD"]


class FusedXPBD:
    """XPBD in one fused kernel: a launch runs many substeps, a thread runs L worlds in SIMD lanes.

    References: Macklin et al., "XPBD", 2016; Macklin et al., "Small Steps in Physics Simulation",
    2019; Mueller et al., "Detailed Rigid Body Simulation with Extended Position Based Dynamics",
    2020.

    Simulates particles joined by springs (two-sided, minimum, maximum, strain-limited), contact and
    friction between particles, with triangles, with the table z = 0 and with rigid bodies made of
    boxes, and grips.
    Worlds of equal topology share lanes; mixed models are grouped by topology.
    """

    def __init__(
        self,
        model: newton.Model,
        config: SolverConfig | None = None,
        *,
        lanes: int | None = None,
        precision: str = "float32",
        pairs_per_particle: int = 48,
        bundles: Path | None = None,
        threads: int | None = None,
    ) -> None:
        """Pack `model`.

        Args:
            lanes: worlds a thread; None takes 8 for many worlds on the CPU and 1 otherwise
            precision: "float32" or "float64"
            pairs_per_particle: room in the contact list; a guard fires when it does not suffice
            bundles: folder that gets a reproducing file whenever a guard fires
            threads: that share a launch on the CPU, a group of lanes at a time; None takes one a
                core (see `default_threads`)
        """
        self.model = model
        self.config = config or SolverConfig()
        scalars = {"float32": wp.float32, "float64": wp.float64}
        if precision not in scalars:
            raise InputError(f"precision must be float32 or float64, not {precision!r}")
        if lanes is None:
            lanes = 8 if model.world_count > 1 and model.device.is_cpu else 1
        self.data = SolverData(
            model, scalar=scalars[precision], lanes=lanes, pairs_per_particle=pairs_per_particle
        )
        self.threads = _thread_count(threads, self.data)
        self.bundles = bundles
        self.bundle: Path | None = None
        self.continued = np.zeros(self.data.world_count, bool)
        """Which worlds are in the midst of a launch that goes on, see `ContinuedLaunch`."""
        self._kernel = forward_kernel(*self.data.variant)
        self._launch: GroupLaunch | None = None
        self._launch_settings: Any = None
        self._cached_settings: tuple[Any, Any] | None = None
        self._gravity()
        self._viscous_share(self.config.viscosity, self.damp_every() * self.config.dt)
        # padded lanes divide by their stiffness as well
        self.data.views["group.stiffness"][:] = 1.0
        self.activate()
        for w in range(self.data.world_count):
            self.set_world(
                w,
                damping=self.config.damping,
                table_friction=self.config.table_friction,
                contact_friction=self.config.contact_friction,
                stiffness=self.config.stiffness,
            )
        self.set_duration(FOREVER, FOREVER)

    # -- parameters

    def set_world(self, world: int, **parameters: float) -> None:
        """Set damping [1/s], table_friction, contact_friction or stiffness of one world.

        Where one changes, no fabric sleeps on.
        """
        for name, value in parameters.items():
            if name not in WORLD_PARAMETERS:
                known = ", ".join(WORLD_PARAMETERS)
                raise InputError(f"a world has no parameter {name!r}; it has {known}")
            check_number(value, name, POSITIVE if name == "stiffness" else NOT_NEGATIVE)
            place = self.data.per_world(f"group.{name}", world)
            if (place != place.dtype.type(value)).any():
                self.data.wake(world)
                self.data.edits += 1
            place[:] = value

    def set_duration(
        self,
        min_steps: float | np.ndarray,
        max_steps: float | np.ndarray,
        *,
        calm: float = 0.0,
        calm_after: float = 0.0,
    ) -> None:
        """Substeps that worlds run at least after their path, and at most in all, when launched.

        `calm`, `calm_after`: substeps clamped to `calm_speed` from the start and after a release.
        """
        for w in range(self.data.world_count):
            for name, value in (("least_steps", min_steps), ("most_steps", max_steps)):
                self.data.per_world(f"group.{name}", w)[:] = np.broadcast_to(
                    value, self.data.world_count
                )[w]
            self.data.per_world("group.calm_steps", w)[:] = calm
            self.data.per_world("group.calm_after", w)[:] = calm_after

    def activate(self, worlds: np.ndarray | None = None) -> None:
        """Only these worlds take part in the next launches (None: all); others keep their state.

        Raises:
            InputError: one is in the midst of a launch that goes on.
        """
        busy = np.flatnonzero(self.continued)
        if len(busy):
            busy = busy if worlds is None else np.intersect1d(worlds, busy)
        if len(busy):
            raise InputError(f"world {busy[0]} is under control: end its control first")
        view = self.data.views["group.active"]
        view[:] = 0.0
        for w in range(self.data.world_count) if worlds is None else worlds:
            self.data.per_world("group.active", int(w))[:] = 1.0

    def _gravity(self) -> None:
        gravity = self.model.gravity.numpy()
        self.data.edits += 1
        for w in range(self.data.world_count):
            self.data.per_world("group.gravity", w)[:] = gravity[min(w, len(gravity) - 1)][:, None]
            self.data.wake(w)

    # -- reading

    def particle_q(self, world: int) -> np.ndarray:
        """Positions (P, 3) [m] of one world's particles, in the solver's precision."""
        return self.data.lane("particles.x", world).copy()

    def particle_qd(self, world: int) -> np.ndarray:
        """Velocities (P, 3) [m/s] of one world's particles."""
        return self.data.lane("particles.v", world).copy()

    def body_q(self, world: int) -> np.ndarray:
        """Poses (B, 7) of one world's bodies: position [m] of the body's frame, quat_xyzw."""
        return self.data.body_poses(world)[0]

    def body_qd(self, world: int) -> np.ndarray:
        """Twists (B, 6) of one world's bodies: of the centre of mass [m/s], angular [rad/s]."""
        return self.data.body_poses(world)[1]

    # -- running

    def run(
        self,
        max_steps: int,
        *,
        record_every: int = 0,
        dt: float | None = None,
        damp_every: int | None = None,
    ) -> list[WatchValues]:
        """Launch up to `max_steps` substeps; returns the guards' values by world.

        Worlds stop early as `set_duration` says. Nothing is raised, see `check`; but when a guard
        fires and the solver has a folder for bundles, `bundle` is the file that reproduces it.

        Args:
            dt: length of a substep [s], None: as configured. What is given per second, or in
                seconds, is turned into shares and numbers of these substeps.
            damp_every: substeps between two visits of viscosity, from the first one on; None: as
                many as `damp_every` says
        """
        data = self.data
        frames = -(-max_steps // record_every) if record_every else 0
        if frames > data.frame_room:
            data.reserve_frames(frames)
            self._launch = None
        dt = dt or self.config.dt
        settings = self._settings(max_steps, record_every, dt, damp_every or self.damp_every(dt=dt))
        data.clear_watch()
        inputs = {}
        if self.bundles is not None:
            inputs = {name: view.copy() for name, view in data.views.items()}
        data.to_device()
        self._recorded(settings).launch(max_steps)
        data.to_host()
        values = self._values()
        if self.bundles is not None and self._problems(values):
            self.bundle = write_bundle(self.bundles, self.data, settings, inputs)
        return values

    def _problems(self, values: list[WatchValues]) -> tuple[Problem, ...]:
        """What is wrong with the worlds that took part."""
        limits = self.config.limits
        return tuple(p for w, v in enumerate(values) if v.steps for p in v.problems(w, limits))

    def _settings(self, max_steps: int, record_every: int, dt: float, damp_every: int) -> Any:
        """The kernel's settings, not to be changed: launches alike, which is most, share them."""
        key = self.config, max_steps, record_every, dt, damp_every
        if self._cached_settings is None or self._cached_settings[0] != key:
            self._cached_settings = key, self._new_settings(*key)
        return self._cached_settings[1]

    def _new_settings(
        self, config: SolverConfig, max_steps: int, record_every: int, dt: float, damp_every: int
    ) -> Any:
        data = self.data
        settings = data.types.Settings()
        settings.dt = dt
        settings.max_steps = max_steps
        settings.recovery = config.recovery
        settings.max_speed = config.max_speed
        settings.calm_speed = config.calm_speed
        settings.margin = config.margin
        settings.rest_speed = config.rest_speed
        settings.damp_every = damp_every
        settings.viscous = self._viscous_share(config.viscosity, damp_every * dt)
        settings.sleep = config.sleep_speed
        settings.sleep_after = config.sleep_seconds
        settings.wake = config.wake_speed
        settings.sleep_ramp = config.sleep_ramp
        settings.rest_steps = max(1, round(config.rest_seconds / dt))
        settings.check_every = 20
        settings.record_every = record_every
        settings.particle_stride = int(data.group_particle[-1])
        settings.body_stride = int(data.group_body[-1])
        return settings

    def damp_every(self, steps: int = 0, *, dt: float | None = None) -> int:
        """Substeps between two visits of viscosity: `DAMP_EVERY`, or what all the meshes bear.

        Args:
            steps: of a launch that others follow, which has its share: a divisor of it
            dt: length of a substep [s], None: as configured
        """
        viscosity, dt = self.config.viscosity, dt or self.config.dt
        numbers = [every for every in range(DAMP_EVERY, 0, -1) if steps % every == 0]
        if viscosity == 0.0:
            return numbers[0]
        most = self._greatest_loss
        return next((n for n in numbers if -math.expm1(-viscosity * n * dt) <= most), 1)

    def _viscous_share(self, viscosity: float, seconds: float) -> float:
        """Share of their relative velocity that neighbours lose in so many seconds."""
        share = -math.expm1(-viscosity * seconds)
        most = self._greatest_loss if share > 0.0 else 1.0
        if share > most:
            raise InputError(
                f"a viscosity of {viscosity:g}/s would shake these fabrics apart: with this "
                f"substep it may be {-math.log1p(-most) / seconds:.3g}/s at most"
            )
        return share

    @functools.cached_property
    def _greatest_loss(self) -> float:
        """Largest share that neighbours of any fabric may lose at once, by the model's masses."""
        data, inverse = self.data, self.model.particle_inv_mass.numpy().astype(float)
        alike = {
            (k, inverse[ids].tobytes()): (data.topologies[k], inverse[ids])
            for k, ids in zip(data.world_topology, data.particle_ids, strict=True)
        }
        losses = [greatest_loss(pairs, w) for top, w in alike.values() for pairs in pieces(top)]
        return min(losses, default=math.inf)

    def _recorded(self, settings: Any) -> GroupLaunch:
        """A recorded launch: three times cheaper to repeat than an eager one."""
        if self._launch is None:
            self._launch = self.group_launch(self._kernel, [settings, *self.data.structs()])
        elif settings is not self._launch_settings:
            self._launch.set_param_at_index(0, settings)
        self._launch_settings = settings
        return self._launch

    def group_launch(self, kernel: Any, inputs: list[Any]) -> GroupLaunch:
        """Record a kernel over all groups, see `GroupLaunch`."""
        return GroupLaunch(
            kernel,
            inputs,
            groups=self.data.group_count,
            size=int(self.data.group_particle[-1] + self.data.group_body[-1]),
            device=self.model.device,
            threads=self.threads,
        )

    def forget_launch(self) -> None:
        """Needed after arrays were replaced (`reserve_knots`)."""
        self._launch = None

    def _values(self) -> list[WatchValues]:
        columns = [self.data.views[f"watch.{name}"].ravel().tolist() for name in WATCHED]
        out = []
        for slot in self.data.slot:
            seen = dict(zip(WATCHED, (c[slot] for c in columns), strict=True))
            whole = {name: int(seen.pop(name)) for name in ("steps", "clamped", "overflow")}
            out.append(WatchValues(**whole, nonfinite=seen.pop("nonfinite") > 0, **seen))
        return out

    def check(self, values: list[WatchValues]) -> None:
        """Raise `PhysicsError` if a guard fired in any world."""
        problems = self._problems(values)
        if problems:
            raise PhysicsError(problems, self.bundle)


def _thread_count(asked: int | None, data: SolverData) -> int:
    """Threads that share launches over the groups of `data`."""
    count = None if asked is None else int(check_number(asked, "threads", COUNT))
    if data.group_count == 1 or not data.device.is_cpu:
        return 1
    return default_threads() if count is None else count
