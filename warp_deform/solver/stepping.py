"""What `SolverFusedXPBD.step` makes of its arguments: the time, and the grips of a control."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..errors import InputError
from ..support.checked import POSITIVE, check_number
from ..xpbd.packing.data import SolverData

__all__ = ["grip_from_control", "substeps"]

FINEST = 1 / 16
"""Shortest substep of a step, as a share of the configured one: in float32, positions are too
coarse for much shorter ones."""
MOST = 10**6
"""Substeps of one step at most; float32 counts them exactly."""
SAME = 1.0e-6
"""Relative difference below which two times are the same; a time in float32 is as coarse."""


def substeps(dt: Any, usual: float) -> tuple[int, float]:
    """How many substeps of which length [s] make up `dt` [s], none longer than the `usual` one.

    Where whole numbers of the usual substep make up `dt`, that one is taken as it is.

    Raises:
        InputError: `dt` is no positive number, or too short or too long for the usual substep.
    """
    dt = check_number(dt, "dt", POSITIVE)
    if not FINEST * usual * (1 - SAME) <= dt <= MOST * usual:
        raise InputError(
            f"dt is {dt:.6g} s, allowed are {FINEST * usual:.6g} to {MOST * usual:.6g} s with "
            f"SolverConfig.dt {usual:.6g}: choose that one to suit"
        )
    count = max(1, round(dt / usual))
    if abs(dt - count * usual) <= SAME * dt:
        return count, usual
    if count * usual < dt:
        count += 1
    return count, dt / count


def grip_from_control(data: SolverData, control: Any, duration: float) -> None:
    """Hold what `control` (its attributes in our namespace) names, for a step of `duration` [s].

    Raises:
        InputError: there is no such particle, or its target is not finite.
    """
    views, targets = data.views, control.grip_target.numpy()
    for w, particle in enumerate(control.grip_particle.numpy()):
        if particle < 0:
            continue
        slot, count = data.slot[w], data.topologies[data.world_topology[w]].particle_count
        if particle >= count or not np.isfinite(targets[w]).all():
            raise InputError(
                f"grip in world {w}: a particle below {count} and a finite target are needed, got "
                f"particle {particle} and target {targets[w].tolist()}"
            )
        start = data.lane("particles.x", w)[particle]
        first = 2 * slot
        for name, value in (
            ("particle", particle), ("tick", 0), ("knot", first),
            ("knot_end", first + 2), ("offset", 0.0), ("turn", (0, 0, 0, 1)), ("shift", 0.0),
            ("lower_start", 0.0), ("lower_end", 0.0),
        ):  # fmt: skip
            views[f"grips.{name}"][slot] = value
        # the knots end after the step, so that the grip lasts through it
        beyond = 2.0
        views["grips.time"][first : first + 2] = 0.0, beyond * duration
        views["grips.position"][first] = start
        views["grips.position"][first + 1] = start + beyond * (targets[w] - start)
        views["grips.rotation"][first : first + 2] = (0, 0, 0, 1)
        data.tether(w, int(particle))
