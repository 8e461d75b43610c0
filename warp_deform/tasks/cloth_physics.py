"""What all fabric tasks share: how fabrics behave, and how they are carried."""

from __future__ import annotations

from dataclasses import replace

from ..objects.cloth import ClothConfig
from ..robots.primitive import PrimitiveConfig
from ..xpbd.config import SolverConfig

__all__ = ["CLOTH_SOLVER", "FABRIC", "FABRIC_PRIMITIVE", "FABRIC_SOLVER", "FABRIC_SPEED"]

CLOTH_SOLVER = SolverConfig(
    table_friction=0.7,
    contact_friction=0.3,
    recovery=0.3,
    margin=0.002,
    viscosity=15.0,
    sleep_speed=0.006,
    sleep_ramp=20.0,
)
"""Viscosity calms a sheet that is let hang 5 degrees askew to half a degree in 2 s. Layers part
three times as fast as beads: at 0.1 m/s edges that have crossed once stay crossed. The margin is
short to list few pairs."""

FABRIC_SOLVER = replace(CLOTH_SOLVER, table_friction=0.5, margin=0.006)
"""With more room in the contact list than `CLOTH_SOLVER` gives it is made anew less often, which
costs a quarter less."""

FABRIC = ClothConfig(edge_contact=0.2, bend_stiffness=1.0, exclusion=0.9)
"""The fabric of the tasks. It is as stiff as canvas, so that what crumples under a pull smooths
again as in the original; its edges do not pass through each other, nor do a vertex and the
triangles beside its own."""

FABRIC_SPEED = 0.40
"""Speed of the tip that holds a fabric [m/s]."""

FABRIC_PRIMITIVE = PrimitiveConfig(sheet_release=0.006)
"""A vertex is let go about one layer above the table, and falls."""
