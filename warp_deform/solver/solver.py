"""`SolverFusedXPBD`: the solver behind every task, as a Newton solver."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverBase

from ..checked import NOT_NEGATIVE, POSITIVE, check_number
from ..errors import InputError
from ..objects.attributes import NAMESPACE, register_attributes
from .config import SolverConfig
from .data import WATCHED, SolverData
from .forward import forward_kernel
from .guards import PhysicsError, Problem, WatchValues
from .stepping import grip_from_control, substeps

if TYPE_CHECKING:
    from ..newton_tape import TapedStep

__all__: list[str] = []  # `warp_deform.solver` is the import path of what is here

_FOREVER = 1.0e7
"""More substeps than any launch has, exactly representable in float32."""


class SolverFusedXPBD(SolverBase):
    """XPBD in one fused kernel: a launch runs many substeps, a thread runs L worlds in SIMD lanes.

    References: Macklin et al., "XPBD", 2016; Macklin et al., "Small Steps in Physics Simulation",
    2019; Mueller et al., "Detailed Rigid Body Simulation with Extended Position Based Dynamics",
    2020.

    Simulates particles joined by springs (two-sided, minimum, maximum, strain-limited), contact and
    friction between particles, with triangles, with the table z = 0 and with rigid bodies made of
    boxes, and grips.
    Worlds of equal topology share lanes; mixed models are grouped by topology.

    Limitations: no joints, no shapes other than boxes; the only ground is z = 0; `Contacts` are
    ignored, contacts are found in the kernel. The state in `newton.State` is float32 whatever the
    solver's precision.

    Example:
        builder = newton.ModelBuilder()
        config = CableConfig()
        add_cable(builder, config, cable_line(config, (0.5, -0.2), (0.5, 0.2)))
        model = builder.finalize(device="cpu")
        solver = SolverFusedXPBD(model)
        state, after = model.state(), model.state()
        solver.step(state, after, None, None, 1 / 60)
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
    ) -> None:
        """Pack `model`.

        lanes: worlds a thread; None takes 8 for many worlds on the CPU and 1 otherwise.
        precision: "float32" or "float64".
        pairs_per_particle: room in the contact list; a guard fires when it does not suffice.
        bundles: folder that gets a reproducing file whenever a guard fires.
        """
        super().__init__(model)
        self.config = config or SolverConfig()
        scalars = {"float32": wp.float32, "float64": wp.float64}
        if precision not in scalars:
            raise InputError(f"precision must be float32 or float64, not {precision!r}")
        if lanes is None:
            lanes = 8 if model.world_count > 1 and model.device.is_cpu else 1
        self.data = SolverData(
            model, scalar=scalars[precision], lanes=lanes, pairs_per_particle=pairs_per_particle
        )
        self.bundles = bundles
        self.bundle: Path | None = None
        self._kernel = forward_kernel(
            scalars[precision],
            lanes,
            bool(self.data.has_bodies),
            self.data.has_sheets,
            self.data.has_edges,
        )
        self._launch: Any = None
        self._launch_settings: Any = None
        self._cached_settings: tuple[Any, Any] | None = None
        self._clamped: list[
            float
        ] = []  # by world: substeps that the clamp acted in, steps in a row
        self._gravity()
        # padded lanes divide by their stiffness as well
        self.data.views["group.stiffness"][:] = 1.0
        self.activate()
        for w in range(self.data.world_count):
            self.set_world(
                w, damping=self.config.damping, table_friction=self.config.table_friction,
                contact_friction=self.config.contact_friction, stiffness=self.config.stiffness,
            )  # fmt: skip
        self.set_duration(_FOREVER, _FOREVER)

    @classmethod
    def register_custom_attributes(cls, builder: newton.ModelBuilder) -> None:
        """Declare the attributes that `add_cable` and the like use, and grips in `Control`.

        ``control.warp_deform.grip_particle`` (worlds,) int32: number of the held particle in its
        world, -1 for none; ``control.warp_deform.grip_target`` (worlds,) vec3 [m]: where it is at
        the end of the step.
        """
        register_attributes(builder)
        for name, dtype, default in (
            ("grip_particle", wp.int32, -1),
            ("grip_target", wp.vec3, wp.vec3(0.0, 0.0, 0.0)),
        ):
            builder.add_custom_attribute(
                newton.ModelBuilder.CustomAttribute(
                    name=name,
                    frequency=newton.Model.AttributeFrequency.WORLD,
                    dtype=dtype,
                    default=default,
                    assignment=newton.Model.AttributeAssignment.CONTROL,
                    namespace=NAMESPACE,
                )
            )

    # -- parameters

    def set_world(self, world: int, **parameters: float) -> None:
        """Set damping [1/s], table_friction, contact_friction or stiffness of one world."""
        for name, value in parameters.items():
            if name not in ("damping", "table_friction", "contact_friction", "stiffness"):
                raise InputError(f"a world has no parameter {name!r}")
            check_number(value, name, POSITIVE if name == "stiffness" else NOT_NEGATIVE)
            self.data.per_world(f"group.{name}", world)[:] = value

    def set_duration(
        self,
        least: float | np.ndarray,
        most: float | np.ndarray,
        *,
        calm: float = 0.0,
        calm_after: float = 0.0,
    ) -> None:
        """Substeps that worlds run at least after their path, and at most in all, when launched.

        `calm`, `calm_after`: substeps clamped to `calm_speed` from the start and after a release.
        """
        for w in range(self.data.world_count):
            for name, value in (("least_steps", least), ("most_steps", most)):
                self.data.per_world(f"group.{name}", w)[:] = np.broadcast_to(
                    value, self.data.world_count
                )[w]
            self.data.per_world("group.calm_steps", w)[:] = calm
            self.data.per_world("group.calm_after", w)[:] = calm_after

    def activate(self, worlds: np.ndarray | None = None) -> None:
        """Only these worlds take part in the next launches (None: all); others keep their state."""
        view = self.data.views["group.active"]
        view[:] = 0.0
        for w in range(self.data.world_count) if worlds is None else worlds:
            self.data.per_world("group.active", int(w))[:] = 1.0

    def _gravity(self) -> None:
        gravity = self.model.gravity.numpy()
        for w in range(self.data.world_count):
            self.data.per_world("group.gravity", w)[:] = gravity[min(w, len(gravity) - 1)][:, None]

    def notify_model_changed(self, flags: int) -> None:
        """Read gravity again; other model data are read once, at construction."""
        if flags & int(newton.ModelFlags.MODEL_PROPERTIES):
            self._gravity()

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
        self, max_steps: int, *, record_every: int = 0, dt: float | None = None
    ) -> list[WatchValues]:
        """Launch up to `max_steps` substeps; returns the guards' values by world.

        dt: length of a substep [s], None: as configured. What is given per second, or in seconds,
        is turned into shares and numbers of these substeps.

        Worlds stop early as `set_duration` says. Nothing is raised, see `check`; but when a guard
        fires and the solver has a folder for bundles, `bundle` is the file that reproduces it.
        """
        data = self.data
        frames = -(-max_steps // record_every) if record_every else 0
        if frames > data.frame_room:
            data.reserve_frames(frames)
            self._launch = None
        settings = self._settings(max_steps, record_every, dt or self.config.dt)
        data.clear_watch()
        inputs = {}
        if self.bundles is not None:
            inputs = {name: view.copy() for name, view in data.views.items()}
        data.to_device()
        self._recorded(settings).launch()
        data.to_host()
        values = self._values()
        if self.bundles is not None and self._problems(values):
            from .bundle import write_bundle

            self.bundle = write_bundle(self.bundles, self.data, settings, inputs)
        return values

    def _problems(self, values: list[WatchValues]) -> tuple[Problem, ...]:
        """What is wrong with the worlds that took part."""
        limits = self.config.limits
        return tuple(p for w, v in enumerate(values) if v.steps for p in v.problems(w, limits))

    def _settings(self, max_steps: int, record_every: int, dt: float) -> Any:
        """The kernel's settings, not to be changed: launches alike, which is most, share them."""
        key = self.config, max_steps, record_every, dt
        if self._cached_settings is None or self._cached_settings[0] != key:
            self._cached_settings = key, self._new_settings(*key)
        return self._cached_settings[1]

    def _new_settings(
        self, config: SolverConfig, max_steps: int, record_every: int, dt: float
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
        settings.viscous = -math.expm1(-config.viscosity * dt)
        settings.dry = config.dry_friction * dt
        settings.sleep = config.sleep_speed
        settings.sleep_ramp = config.sleep_ramp
        settings.rest_steps = max(1, round(config.rest_seconds / dt))
        settings.check_every = 20
        settings.record_every = record_every
        settings.particle_stride = int(data.group_particle[-1])
        settings.body_stride = int(data.group_body[-1])
        return settings

    def _recorded(self, settings: Any) -> Any:
        """A recorded launch: three times cheaper to repeat than an eager one."""
        if self._launch is None:
            self._launch = wp.launch(
                self._kernel,
                dim=self.data.group_count,
                inputs=[settings, *self.data.structs()],
                device=self.model.device,
                record_cmd=True,
                record_tape=False,
            )
        elif settings is not self._launch_settings:
            self._launch.set_param_at_index(0, settings)
        self._launch_settings = settings
        return self._launch

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

    # -- Newton

    def step(
        self,
        state_in: newton.State,
        state_out: newton.State,
        control: newton.Control | None,
        contacts: newton.Contacts | None,
        dt: float,
        *,
        observables: Any = None,
    ) -> None:
        """Advance every world by `dt` [s], in equal substeps no longer than `config.dt`.

        Of `config.dt` itself where `dt` is a multiple of it; otherwise the substep and all that is
        given per second are adapted to `dt`. The guard of the speed clamp counts through steps in a
        row: a fall that the clamp holds up is an error, not a slow fall.

        While a `wp.Tape` records, and what is read has requires_grad, the step's adjoint is left on
        the tape (see `warp_deform.newton_tape`); every such step writes a state of its own.

        Raises:
            InputError: `dt` is no positive number, or no sensible multiple of `config.dt`; a tape
                records, and derivatives would be lost.
            PhysicsError: a guard fired.
        """
        from ..newton_tape import TapedStep, recording, unrecorded

        steps, substep = substeps(dt, self.config.dt)
        ours = getattr(control, NAMESPACE, None) if control is not None else None
        tape, taped = recording(), None
        if tape is not None:
            taped = TapedStep(self, state_in, state_out, ours)
            taped.check(tape)
        with unrecorded():
            values = self._stepped(
                state_in, state_out, ours, steps, substep, taped if taped and taped.needed else None
            )
        if taped is not None and taped.needed:
            taped.record(tape)
        self.check(self._clamped_in_a_row(values, substep / self.config.dt))

    def _stepped(
        self, state_in: newton.State, state_out: newton.State, control: Any, steps: int,
        substep: float, taped: TapedStep | None,
    ) -> list[WatchValues]:  # fmt: skip
        self.read_state(state_in)
        self.data.clear_grips()
        if control is not None and hasattr(control, "grip_particle"):
            grip_from_control(self.data, control, steps * substep)
        if taped is not None:
            values = taped.run(steps, substep)
        else:
            self.set_duration(_FOREVER, _FOREVER)
            self.activate()
            values = self.run(steps, dt=substep)
        self.write_state(state_out)
        return values

    def _clamped_in_a_row(self, values: list[WatchValues], share: float) -> list[WatchValues]:
        """The values with the clamped substeps of the steps before, if all of them had some.

        share: length of a substep as a share of the configured one, in which the guard counts
        """
        before = self._clamped or [0.0] * len(values)
        self._clamped = [
            c + v.clamped * share if v.clamped else 0.0 for c, v in zip(before, values, strict=True)
        ]
        return [replace(v, clamped=round(c)) for c, v in zip(self._clamped, values, strict=True)]

    def read_state(self, state: newton.State) -> None:
        """Take positions and velocities of all worlds from a Newton state."""
        data = self.data
        if data.has_particles:
            q, qd = state.particle_q.numpy(), state.particle_qd.numpy()
            for w in range(data.world_count):
                data.lane("particles.x", w)[:] = q[data.particle_ids[w]]
                data.lane("particles.v", w)[:] = qd[data.particle_ids[w]]
        if data.has_bodies:
            q, qd = state.body_q.numpy(), state.body_qd.numpy()
            for w in range(data.world_count):
                data.set_bodies(w, q[data.body_ids[w]], qd[data.body_ids[w]])

    def write_state(self, state: newton.State) -> None:
        """Give positions and velocities of all worlds to a Newton state."""
        from ..newton_tape import refuse_lost_derivatives

        refuse_lost_derivatives(state)
        data = self.data
        if data.has_particles:
            q = np.empty((self.model.particle_count, 3), np.float32)
            qd = np.empty_like(q)
            for w in range(data.world_count):
                q[data.particle_ids[w]] = data.lane("particles.x", w)
                qd[data.particle_ids[w]] = data.lane("particles.v", w)
            state.particle_q.assign(q)
            state.particle_qd.assign(qd)
        if data.has_bodies:
            q = np.empty((self.model.body_count, 7), np.float32)
            qd = np.empty((self.model.body_count, 6), np.float32)
            for w in range(data.world_count):
                q[data.body_ids[w]], qd[data.body_ids[w]] = data.body_poses(w)
            state.body_q.assign(q)
            state.body_qd.assign(qd)
