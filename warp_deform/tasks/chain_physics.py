"""The bead chain of the physical experiments: 45 cm long, 5 mm thick, on foam rubber.

Source: Seita et al., ICRA 2021, section on physical experiments (length, foam). Diameter, mass and
friction are those of a common plastic ball chain on foam rubber; nobody measured the paper's.
"""

from __future__ import annotations

from ..objects.cable import CableConfig
from ..objects.colors import WHITE
from ..xpbd.config import SolverConfig
from ..xpbd.guards import GuardLimits

__all__ = ["BEAD_CHAIN", "CHAIN_SOLVER", "FOAM_STIFFNESS"]

BEAD_CHAIN = CableConfig(
    beads=90,
    spacing=0.005,
    radius=0.0025,
    visual_radius=0.0025,
    mass=2e-4,  # 18 g in all
    fold_limit=1.7,  # joints bend by 63 degrees at most: the smallest loop is 6 beads wide
    fold_stiffness=100.0,
    bend_stiffness=1.0,  # friction in the joints; foam holds any curve wider than 1 mm against it
    solve="gauss-seidel",  # at half the cost: the substep is short
    color=WHITE,
    first_color=WHITE,
    last_color=WHITE,
)
"""90 beads a diameter apart, so that strands cannot pass between them."""

CHAIN_SOLVER = SolverConfig(
    dt=1 / 2000,  # a link of a chain dragged by its end then stretches by 10 % for a moment
    table_friction=0.8,
    contact_friction=0.2,
    margin=0.003,
    limits=GuardLimits(stretch=2.0),  # fingers that squeeze a chain lengthwise reach 1.5
)
"""Foam rubber holds a chain better than a table does, and lets it bounce less."""

FOAM_STIFFNESS = 3000.0
"""Force by which foam resists a fingertip's pad, or a bead under it, over the depth [N/m]."""
