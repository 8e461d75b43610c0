"""Validation while training: every snapshot plays the same episodes, which `eval` plays not again.

It says when training has nothing left to gain, and, for who waits, how good the policy is by now.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from ..runs.folder import RunFolder
from .processes import Process

if TYPE_CHECKING:
    from ..evaluation.protocol import Protocol

__all__ = ["Validation"]

_TOLD = ("n_success", "n_episodes", "mean_score")


class Validation:
    """Plays a run's snapshots.

    Args:
        run: whose snapshots; its settings say what ends training
        episodes: of validation seeds that each plays; 0: nothing is played, and nothing ends
        here: the first process plays, the others wait
        trained: seeds of the demonstrations
        task: its name

    Raises:
        InputError: an episode would start as a demonstration that is learnt from.
    """

    def __init__(
        self, run: RunFolder, *, episodes: int, here: Process, trained: Iterable[int], task: str
    ) -> None:
        self._run, self._here = run, here
        self._protocol: Protocol | None = None
        self.told = ""
        """How the snapshot that played last did, in a few words."""
        self.found: dict[int, dict[str, Any]] = {}
        """`n_success`, `n_episodes` and `mean_score` of snapshots by step."""
        if episodes:
            from ..evaluation.protocol import Protocol, check_splits  # loads the simulator

            self._protocol = Protocol(split="validation", episodes=episodes)
            check_splits(trained, [self._protocol], task=task)

    def play(self, steps: Sequence[int]) -> bool:
        """Play the snapshots of these steps; returns whether training ends with the last."""
        if self._protocol is None:
            return False
        from ..evaluation.evaluate import evaluate_snapshot, stopped_early

        for step in steps if self._here.rank == 0 else ():
            found = evaluate_snapshot(self._run, step, self._protocol).summary
            self.found[step] = {name: found[name] for name in _TOLD}
            self.told = (
                f"validation {found['n_success']} of {found['n_episodes']} solved, "
                f"mean score {found['mean_score']:.3f}"
            )
        self._here.wait()
        return stopped_early(self._run)
