"""What a check of derivatives covers: fields of a configuration, flags, and their help."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from tyro.conf import arg

from ..support.flag_range import COUNT, SEED

__all__: list[str] = []  # `warp_deform.gradcheck` is the import path of what is here


@dataclass(frozen=True, kw_only=True)
class GradcheckConfig:
    """What is checked, and how much of it."""

    levels: tuple[Literal["substep", "window", "action"], ...] = ("substep", "window", "action")
    """Which levels to check: `substep` (one substep of the solver), `window` (0.1 s of simulation),
    `action` (a whole pick and place). Left out, all three."""
    states: Annotated[int, arg(metavar="N"), COUNT] = 200
    """States whose next substep is differentiated; more where a constraint acts in few of them."""
    windows: Annotated[int, arg(metavar="N"), COUNT] = 30
    """States from which 0.1 s are differentiated."""
    actions: Annotated[int, arg(metavar="N"), COUNT] = 16
    """Whole actions that are differentiated."""
    seed: Annotated[int, SEED] = 0
    """First episode, and the random directions."""
