"""What all bag tasks share: how bags behave, and how they and the items are carried."""

from __future__ import annotations

from ..robots.primitive import PrimitiveConfig
from ..xpbd.config import SolverConfig
from ..xpbd.guards import GuardLimits
from .task import Stage

__all__ = ["BAG_PRIMITIVE", "BAG_SOLVER", "CARRY", "INSERT", "OPEN"]

BAG_SOLVER = SolverConfig(
    table_friction=0.8,
    contact_friction=0.4,
    recovery=0.1,
    margin=0.006,
    viscosity=15.0,
    sleep_speed=0.006,
    sleep_ramp=20.0,
    limits=GuardLimits(stretch=2.0),
)
"""Viscosity inside the shell and sleep on the table bring a crumpled bag to rest in a second. A
short edge near the pole may stretch by more than half for a moment while the bag is dragged over
it."""

OPEN = Stage(lift=0.05, speed=0.25)
"""Low, so that a pulled bead opens the bag instead of lifting it."""
INSERT = Stage(lift=0.30, speed=0.5, lower_speed=0.15, gentle=True)
"""Over the rim, and down softly."""
CARRY = Stage(lift=0.40, speed=0.25, pause=0.3, gentle=True)
"""The whole bag with what is in it, which calms before it is moved and before it is lowered."""

BAG_PRIMITIVE = PrimitiveConfig(hover=0.10, sheet_meets=True)
"""A bead is let go on the heap that it is lowered onto. What holds it is stronger than any contact:
on its way to the table it would be pressed through the layers below, and tear its neighbours along.
"""
