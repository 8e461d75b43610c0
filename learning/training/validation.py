"""Validation while training: every snapshot plays the same episodes; `eval` does not repeat them.

It says when training has nothing left to gain, and reports how good the policy is so far.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from ..runs.folder import RunFolder
from .processes import Process

if TYPE_CHECKING:
    from ..evaluation.protocol import Protocol
    from ..evaluation.summary import Evaluation

__all__ = ["Validation"]

_REPORTED = ("n_success", "n_episodes", "mean_score")


class Validation:
    """Evaluates a run's snapshots on validation seeds.

    Args:
        run: whose snapshots; its settings say what ends training
        episodes: of validation seeds that each plays; 0: nothing is played, and nothing ends
        confirm: further ones that a snapshot plays which solved all of these
        process: of rank 0 plays, others wait
        trained: seeds of the demonstrations
        goals: seeds of the goals that were given to these
        task: its name

    Raises:
        InputError: an episode would start as a demonstration that is learnt from, or have its goal.
    """

    def __init__(
        self,
        run: RunFolder,
        *,
        episodes: int,
        confirm: int,
        process: Process,
        trained: Iterable[int],
        goals: Iterable[int],
        task: str,
    ) -> None:
        self._run, self._process = run, process
        self._protocol: Protocol | None = None
        self.note = ""
        """How the snapshot that played last did, in a few words."""
        self.results: dict[int, dict[str, Any]] = {}
        """`n_success`, `n_episodes` and `mean_score` of snapshots by step, over all they played."""
        self.chosen: int | None = None
        """Step of the snapshot that did best in the episodes that all played, and of equals in
        those that confirm, see `evaluation.summary.best`."""
        self._task = task
        self._evaluations: dict[int, Evaluation] = {}
        self._confirmed: dict[int, float] = {}
        if episodes:
            from ..evaluation.protocol import Protocol, check_splits  # loads the simulator

            self._protocol = Protocol(split="validation", episodes=episodes)
            self._longer = replace(self._protocol, episodes=episodes + confirm)
            check_splits(trained, [self._longer], task=task, goals=goals)

    def evaluate(self, steps: Sequence[int]) -> bool:
        """Evaluate the snapshots of these steps; returns whether training ends with the last."""
        if self._protocol is None:
            return False
        from ..evaluation.snapshot import confirmed, evaluate_snapshot, stopped_early
        from ..evaluation.summary import best

        for step in steps if self._process.rank == 0 else ():
            evaluation = evaluate_snapshot(self._run, step, self._protocol)
            self._evaluations[step], summary = evaluation, evaluation.summary
            if summary["n_success"] == summary["n_episodes"]:
                summary = evaluate_snapshot(self._run, step, self._longer).summary
                self._confirmed[step] = confirmed(self._run, step, self._protocol)
            self.chosen = best(
                list(self._evaluations.values()), task=self._task, confirmed=self._confirmed
            ).step
            self.results[step] = {name: summary[name] for name in _REPORTED}
            self.note = (
                f"validation {summary['n_success']} of {summary['n_episodes']} solved, "
                f"mean score {summary['mean_score']:.3f}"
            )
        self._process.wait()
        return stopped_early(self._run)
