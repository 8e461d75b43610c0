"""How good a trajectory is, and when one is better than another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["LEAST_LOSS", "Measures", "Walk"]

LEAST_LOSS = 1e-3
"""What is left to do counts as so much [m] where it is less: a tenth of a millimetre is no gain."""


@dataclass(frozen=True)
class Measures:
    """How good an episode is; of each, less is better.

    Attributes:
        steps: control steps until the episode ends
        loss: what is left to do (`Task.remaining`) a second after the tip has let go at the end; of
            a task that counts in motion, at the end
        roughness: see `roughness`
    """

    steps: int
    loss: float
    roughness: float

    def over(self, other: Measures) -> np.ndarray:
        """Ratios (3,) to those of another episode."""
        return np.array(
            [
                self.steps / other.steps,
                max(self.loss, LEAST_LOSS) / max(other.loss, LEAST_LOSS),
                self.roughness / max(other.roughness, 1e-9),
            ]
        )


@dataclass(frozen=True, eq=False)
class Walk:
    """What a plan came to.

    Attributes:
        actions: (T, A) float32
        measures: None where a guard has fired
        lacks: how many of the last steps are not solved that have to be
        rests: whether the task is solved where the loss counts
        score: there
    """

    actions: np.ndarray
    measures: Measures | None
    lacks: int
    rests: bool
    score: float

    def beats(self, recorded: Walk) -> bool:
        """Whether this is better than a recording in one respect, and worse in none.

        A loss below `LEAST_LOSS` counts as that.
        """
        if self.measures is None or recorded.measures is None:
            return False
        ratios = self.measures.over(recorded.measures)
        fine = self.rests >= recorded.rests and self.score >= recorded.score
        return fine and bool((ratios <= 1.0).all() and (ratios < 1.0).any())
