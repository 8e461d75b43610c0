"""The history of an episode: what each past action held, and where things were while it hung."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..robots.primitive import Outcome

__all__ = ["Aloft", "PastAction"]


@dataclass(frozen=True, eq=False)
class Aloft:
    """The world while the tip holds something at its highest, before it begins to lower it.

    particle_q (P, 3) float32 [m]; body_q (B, 7) float32 position [m] and quat_xyzw
    """

    particle_q: np.ndarray
    body_q: np.ndarray


@dataclass(frozen=True, eq=False)
class PastAction:
    """One action of an episode and what came of it.

    Attributes:
        action: (7,) as in `task.Action`
        held: number, among the world's objects, of what the tip carried; None for nothing
        aloft: the world while what was held hung highest; None where nothing was carried, or the
            task does not ask for it (`Task.looks_aloft`)
    """

    action: np.ndarray
    outcome: Outcome
    held: int | None = None
    aloft: Aloft | None = None

    @property
    def lift(self) -> float:
        """At which height it carried [m]."""
        return float(self.action[6])
