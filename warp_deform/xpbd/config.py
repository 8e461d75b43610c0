"""Parameters of the solver. Importing this loads neither Warp nor Newton."""

from __future__ import annotations

from dataclasses import dataclass, field

from ..errors import InputError
from ..support.checked import NOT_NEGATIVE, POSITIVE, Interval, check_fields
from .guards import GuardLimits

__all__ = ["FOREVER", "WORLD_PARAMETERS", "SolverConfig"]

FOREVER = 1.0e7
"""More substeps than any launch has, exactly representable in float32."""

WORLD_PARAMETERS = ("damping", "table_friction", "contact_friction", "stiffness")
"""What may differ from world to world, see `set_world`, and has derivatives."""


@dataclass(frozen=True, kw_only=True)
class SolverConfig:
    """Parameters that all worlds share; those of a single world are set with `set_world`."""

    dt: float = 1 / 60 / 20
    """Substep [s]."""
    damping: float = 0.0
    """Drag of the air, against the world [1/s]; 0: what is free falls as in a vacuum."""
    table_friction: float = 0.5
    """Coulomb coefficient of particles, and factor on that of boxes, against the table."""
    contact_friction: float = 0.3
    """Coulomb coefficient between particles, and factor on that of boxes and of triangles."""
    stiffness: float = 1.0
    """Factor on the stiffness of all springs."""
    recovery: float = 0.1
    """Fastest separation of overlapping things [m/s]."""
    max_speed: float = 3.0
    """Speed clamp [m/s]; a particle that meets it is counted by the guards."""
    calm_speed: float = 0.1
    """Speed clamp while a world is calmed, after a release for example [m/s]."""
    margin: float = 0.005
    """Pairs this much farther apart than touching are listed [m]; of fabrics the largest slack per
    particle."""
    rest_speed: float = 0.01
    """Slower than this is at rest [m/s]."""
    rest_seconds: float = 0.05
    """At rest for so long ends a world's rollout [s]."""
    viscosity: float = 0.0
    """Damping rate of the relative velocity between neighbours in a fabric, rigid rotation left out
    [1/s]; refused where it would be unstable with the fabrics' meshes and the substep."""
    sleep_speed: float = 0.0
    """Particles of fabrics with a lower mean speed fall asleep where something carries them [m/s];
    0: none does."""
    sleep_seconds: float = 0.25
    """Time over which that is the mean [s]."""
    wake_speed: float = 0.12
    """A sleeper that a substep would move faster than this wakes [m/s]."""
    sleep_ramp: float = 10.0
    """Factor by which the sleep speed of boxes in worlds with triangles grows from 1 s to 2 s after
    a release."""
    limits: GuardLimits = field(default_factory=GuardLimits)

    def __post_init__(self) -> None:
        check_fields(
            self,
            dict.fromkeys(("dt", "calm_speed", "margin", "rest_speed", "stiffness", "sleep_seconds",
                           "wake_speed"), POSITIVE)
            | dict.fromkeys(
                ("damping", "table_friction", "contact_friction", "recovery", "rest_seconds",
                 "viscosity", "sleep_speed", "sleep_ramp"), NOT_NEGATIVE,
            )
            | {"max_speed": Interval(low=0.0, above_low=True, infinite=True)},
        )  # fmt: skip
        if not isinstance(self.limits, GuardLimits):
            raise InputError(f"SolverConfig.limits must be GuardLimits, got {self.limits!r}")
