"""What episodes amount to: the textbook's interval, the paper's value, and the best snapshot."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from learning.evaluation.summary import Evaluation, PlayedEpisode, best, summarise

TASK = "cable-line-notarget"


def played(scores: list[float], successes: int) -> list[PlayedEpisode]:
    return [
        PlayedEpisode(seed, seed < successes, score, 3 + seed, "solved")
        for seed, score in enumerate(scores)
    ]


def test_a_summary_is_what_the_textbook_says() -> None:
    summary = summarise(played([1.0] * 15 + [0.5] * 5, 15), task=TASK)
    assert summary["n_episodes"] == 20 and summary["n_success"] == 15
    # Wilson's interval for 15 of 20, in closed form
    n, p, z = 20, 0.75, 1.959963984540054
    centre = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n)) / (1 + z * z / n)
    assert summary["pc_success_ci95"] == pytest.approx(
        [100 * (centre - half), 100 * (centre + half)]
    )
    assert summary["mean_score"] == pytest.approx(0.875)
    assert summary["standard_error"] == pytest.approx(
        np.std([1] * 15 + [0.5] * 5, ddof=1) / 20**0.5
    )
    assert summary["mean_actions"] == pytest.approx(12.5)
    assert summary["mean_actions_solved"] == pytest.approx(10.0)


@pytest.mark.parametrize(("task", "value"), [(TASK, 87.5), ("cable-ring", 75.0)])
def test_the_papers_value_is_partial_credit_for_some_tasks(task: str, value: float) -> None:
    assert summarise(played([1.0] * 15 + [0.5] * 5, 15), task=task)["paper_value"] == value


def test_successes_whose_items_the_bag_enclosed_are_counted_apart() -> None:
    plain = played([1.0, 1.0, 1.0, 0.1], 3)
    ends = (True, False, None, True)  # of the third the physics was not trusted
    episodes = [replace(each, enclosed=held) for each, held in zip(plain, ends, strict=True)]
    summary = summarise(episodes, task="bag-items-1")
    assert (summary["n_success"], summary["n_success_enclosed"]) == (3, 1)
    assert summarise(plain, task="bag-items-1")["n_success_enclosed"] is None


def test_without_successes_and_with_one_episode() -> None:
    summary = summarise(played([0.25], 0), task=TASK)
    assert summary["mean_actions_solved"] is None and summary["standard_error"] is None
    assert summary["pc_success_ci95"][0] == pytest.approx(0.0, abs=1e-9)
    json.dumps(summary, allow_nan=False)


def test_the_best_snapshot_counts_what_the_task_counts() -> None:
    def made(step: int, scores: list[float], successes: int) -> Evaluation:
        episodes = tuple(played(scores, successes))
        return Evaluation(step, episodes, summarise(episodes, task=TASK))

    evaluations = [made(1, [0.9, 0.9], 0), made(2, [1.0, 0.1], 1), made(3, [0.9, 0.9], 0)]
    assert best(evaluations, task=TASK).step == 3, "of equals the latest"
    assert best(evaluations, task="cable-ring").step == 2
    hasty = replace(evaluations[0], summary={**evaluations[0].summary, "mean_actions": 1.0})
    assert best([hasty, *evaluations[1:]], task=TASK).step == 1, "of equals that with fewer actions"
