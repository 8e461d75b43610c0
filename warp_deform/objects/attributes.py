"""Newton custom attributes: what this package's objects mean beyond particles and springs.

They live in the namespace ``warp_deform`` of a `newton.ModelBuilder`, so `replicate` copies them
with the worlds and any Newton tool can read them from the finished model.
"""

from __future__ import annotations

import functools
import sys
from enum import IntEnum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import newton

__all__ = ["NAMESPACE", "SpringMode", "attribute", "register_attributes"]

NAMESPACE = "warp_deform"


class SpringMode(IntEnum):
    """When a spring acts, and on which distance."""

    EQUAL = 0  # always: the distance is the rest length
    AT_LEAST = 1  # only when shorter than the rest length (fold limits)
    AT_MOST = 2  # only when longer than the rest length (tension-only diagonals)
    BEND = 3  # on a third particle: its distance from the middle of the two is the rest length
    # solved together with the springs that follow and go on where this one ends
    CHAIN = 4  # as EQUAL
    BEAM = 5  # as BEND, with rest length 0


def attribute(name: str) -> str:
    """Key of one of our attributes in the ``custom_attributes`` argument of Newton's builders."""
    return f"{NAMESPACE}:{name}"


_FORWARD_ONLY = ("newton._src.utils.mesh", "newton._src.geometry.bvh")
"""Where the kernels stand that `newton.ModelBuilder.finalize` launches: who is whose neighbour, and
what encloses what. Nobody differentiates by these, and they run once a model: to compile them with
adjoints, and optimised, would only delay the first scene of a new machine."""
_ONCE = {"enable_backward": False, "optimization_level": 0}


@functools.cache
def _leave_adjoints_out() -> None:
    import warp as wp

    for name in _FORWARD_ONLY:
        # Newton may put them elsewhere one day: then they compile as it wants them to
        if name in sys.modules:
            wp.set_module_options(_ONCE, sys.modules[name])


def register_attributes(builder: newton.ModelBuilder) -> None:
    """Declare our custom attributes on `builder`; calling it again changes nothing.

    ========================  =========  ===================================================
    attribute                 frequency  meaning
    ========================  =========  ===================================================
    spring_mode               spring     a `SpringMode`
    spring_limit              spring     strain limit: largest length / rest length; 0 = none
    spring_floor              spring     smallest length / rest length; 0 = none
    spring_middle             spring     BEND, BEAM: the particle between the two
    particle_object           particle   which object of its world a particle belongs to
    particle_rest             particle   position in the object's undeformed shape [m]
    particle_exclusion        particle   no self-contact closer than this in the rest shape [m]
    particle_skin             particle   its share of the distance at which particles and
                                         triangles touch [m]; 0 = the radius
    particle_edge_gap         particle   distance at which edges of triangles touch [m]; 0 = never
    triangle_friction         triangle   factor on the solver's contact friction
    ========================  =========  ===================================================
    """
    # Newton takes seconds to import, and the tasks can be listed without it.
    import newton
    import warp as wp

    _leave_adjoints_out()

    frequency = newton.Model.AttributeFrequency
    for name, where, dtype, default, references in (
        ("spring_mode", frequency.SPRING, wp.int32, int(SpringMode.EQUAL), None),
        ("spring_limit", frequency.SPRING, wp.float32, 0.0, None),
        ("spring_floor", frequency.SPRING, wp.float32, 0.0, None),
        ("spring_middle", frequency.SPRING, wp.int32, -1, frequency.PARTICLE),
        ("particle_object", frequency.PARTICLE, wp.int32, 0, None),
        ("particle_rest", frequency.PARTICLE, wp.vec3, wp.vec3(0.0, 0.0, 0.0), None),
        ("particle_exclusion", frequency.PARTICLE, wp.float32, 0.0, None),
        ("particle_skin", frequency.PARTICLE, wp.float32, 0.0, None),
        ("particle_edge_gap", frequency.PARTICLE, wp.float32, 0.0, None),
        ("triangle_friction", frequency.TRIANGLE, wp.float32, 1.0, None),
    ):
        builder.add_custom_attribute(
            newton.ModelBuilder.CustomAttribute(
                name=name,
                frequency=where,
                dtype=dtype,
                default=default,
                references=references,
                assignment=newton.Model.AttributeAssignment.MODEL,
                namespace=NAMESPACE,
            )
        )


def next_object(builder: newton.ModelBuilder) -> int:
    """Number for a new object of this world: one more than the largest in use."""
    values = builder.custom_attributes[attribute("particle_object")].values
    used = values.values() if isinstance(values, dict) else values
    return 1 + max((int(v) for v in used or () if v is not None), default=-1)
