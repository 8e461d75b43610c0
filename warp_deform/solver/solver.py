"""`SolverFusedXPBD`: the engine behind every task, as a Newton solver."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverBase

from ..objects.attributes import NAMESPACE, register_attributes
from ..xpbd.config import FOREVER, SolverConfig
from ..xpbd.fused_xpbd import FusedXPBD
from ..xpbd.guards import WatchValues
from .newton_tape import TapedStep, recording, refuse_lost_derivatives, unrecorded
from .stepping import grip_from_control, substeps

__all__: list[str] = []  # `warp_deform.solver` is the import path of what is here


class SolverFusedXPBD(FusedXPBD, SolverBase):
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

    For example:

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
        SolverBase.__init__(self, model)
        FusedXPBD.__init__(
            self,
            model,
            config,
            lanes=lanes,
            precision=precision,
            pairs_per_particle=pairs_per_particle,
            bundles=bundles,
            threads=threads,
        )
        self._clamped: list[float] = []
        """By world: substeps that the clamp acted in, steps in a row."""

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

    def notify_model_changed(self, flags: int) -> None:
        """Read gravity again; other model data are read once, at construction."""
        if flags & int(newton.ModelFlags.MODEL_PROPERTIES):
            self._gravity()

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
        the tape (see `newton_tape`); every such step writes a state of its own.

        Raises:
            InputError: `dt` is no positive number, or no sensible multiple of `config.dt`; a tape
                records, and derivatives would be lost.
            PhysicsError: a guard fired.
        """
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
        self,
        state_in: newton.State,
        state_out: newton.State,
        control: Any,
        steps: int,
        substep: float,
        taped: TapedStep | None,
    ) -> list[WatchValues]:
        self.read_state(state_in)
        self.data.clear_grips()
        if control is not None and hasattr(control, "grip_particle"):
            grip_from_control(self.data, control, steps * substep)
        if taped is not None:
            values = taped.run(steps, substep)
        else:
            self.set_duration(FOREVER, FOREVER)
            self.activate()
            every = self.damp_every(steps, dt=substep)
            values = self.run(steps, dt=substep, damp_every=every)
        self.write_state(state_out)
        return values

    def _clamped_in_a_row(self, values: list[WatchValues], share: float) -> list[WatchValues]:
        """The values with the clamped substeps of the steps before, if all of them had some.

        Args:
            share: length of a substep as a share of the configured one, in which the guard counts
        """
        before = self._clamped or [0.0] * len(values)
        self._clamped = [
            c + v.clamped * share if v.clamped else 0.0 for c, v in zip(before, values, strict=True)
        ]
        return [replace(v, clamped=round(c)) for c, v in zip(self._clamped, values, strict=True)]

    def read_state(self, state: newton.State) -> None:
        """Take positions and velocities of all worlds from a Newton state.

        Where these are not what the solver gave last, no fabric sleeps.
        """
        data = self.data
        if data.has_particles:
            positions, velocities = state.particle_q.numpy(), state.particle_qd.numpy()
            for w in range(data.world_count):
                x, v = data.lane("particles.x", w), data.lane("particles.v", w)
                now = positions[data.particle_ids[w]], velocities[data.particle_ids[w]]
                known = np.array_equal((x.astype(np.float32), v.astype(np.float32)), now)
                x[:], v[:] = now
                if not known:
                    data.wake(w)
        if data.has_bodies:
            poses, twists = state.body_q.numpy(), state.body_qd.numpy()
            for w in range(data.world_count):
                data.set_bodies(w, poses[data.body_ids[w]], twists[data.body_ids[w]])

    def write_state(self, state: newton.State) -> None:
        """Give positions and velocities of all worlds to a Newton state."""
        refuse_lost_derivatives(state)
        data = self.data
        if data.has_particles:
            positions = np.empty((self.model.particle_count, 3), np.float32)
            velocities = np.empty_like(positions)
            for w in range(data.world_count):
                positions[data.particle_ids[w]] = data.lane("particles.x", w)
                velocities[data.particle_ids[w]] = data.lane("particles.v", w)
            state.particle_q.assign(positions)
            state.particle_qd.assign(velocities)
        if data.has_bodies:
            poses = np.empty((self.model.body_count, 7), np.float32)
            twists = np.empty((self.model.body_count, 6), np.float32)
            for w in range(data.world_count):
                poses[data.body_ids[w]], twists[data.body_ids[w]] = data.body_poses(w)
            state.body_q.assign(poses)
            state.body_qd.assign(twists)
