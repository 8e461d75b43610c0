"""Intervals that know of clusters: closed forms, and how often they hold what is true."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from learning.evaluation.clustered import clustered_mean, clustered_rate
from learning.evaluation.summary import wilson
from warp_deform.errors import InputError

GOALS = [goal for goal in range(10) for _ in range(10)]


@pytest.mark.parametrize("solved", range(11))
def test_one_episode_a_cluster_is_wilsons_interval(solved: int) -> None:
    interval = clustered_rate([i < solved for i in range(10)], range(10))
    assert interval == pytest.approx(wilson(solved, 10), abs=1e-9)


def test_one_value_a_cluster_is_students_interval() -> None:
    values = [3.0, 5.0, 10.0, 4.0]
    mean, half = clustered_mean(values, "abcd")
    assert mean == 5.5
    assert half == pytest.approx(stats.t.ppf(0.975, 3) * np.std(values, ddof=1) / 2.0)


def test_episodes_that_repeat_their_cluster_tell_nothing_more() -> None:
    """Ten times the same ten episodes: about the interval of ten, certainly not of a hundred."""
    solved = [goal < 6 for goal in GOALS]
    ten_means = clustered_mean([10.0 * (goal < 6) for goal in range(10)], range(10))
    assert clustered_mean([10.0 * s for s in solved], GOALS) == pytest.approx(ten_means)
    low, high = clustered_rate(solved, GOALS)
    ten = wilson(6, 10)
    assert low == pytest.approx(ten[0], abs=5.0) and high == pytest.approx(ten[1], abs=5.0)
    assert high - low > 2.2 * np.subtract(*wilson(60, 100)[::-1])


def test_clusters_all_alike_are_no_narrower_than_independent_episodes() -> None:
    """Six of ten solved at every goal: less spread than chance has is no more information."""
    solved = [toss < 6 for _ in range(10) for toss in range(10)]
    low, high = clustered_rate(solved, GOALS)
    assert low < wilson(60, 100)[0] and high > wilson(60, 100)[1]


def test_where_all_or_none_succeed_each_cluster_counts_as_one() -> None:
    assert clustered_rate([False] * 100, GOALS) == pytest.approx(wilson(0, 10))
    assert clustered_rate([True] * 100, GOALS) == pytest.approx(wilson(10, 10))


def test_order_and_names_do_not_matter() -> None:
    rng = np.random.default_rng(0)
    solved, order = rng.random(100) < 0.7, rng.permutation(100)
    names = [f"goal {goal}" for goal in GOALS]
    shuffled = clustered_rate(solved[order], [names[i] for i in order])
    assert shuffled == pytest.approx(clustered_rate(solved, GOALS))


def test_the_interval_holds_the_rate_of_all_goals_as_often_as_it_says() -> None:
    """Goals whose rates differ, as the policies' do: of ten of them, ten tosses each, plain
    Wilson's interval misses the mean over all goals several times as often as it says.
    """
    rng, true, draws = np.random.default_rng(1), 60.0, 600
    held = {"clustered": 0, "wilson": 0}
    for _ in range(draws):
        rates = rng.beta(1.2, 0.8, 10)
        solved = rng.random((10, 10)) < rates[:, None]
        low, high = clustered_rate(solved.ravel().tolist(), GOALS)
        held["clustered"] += low <= true <= high
        low, high = wilson(int(solved.sum()), 100)
        held["wilson"] += low <= true <= high
    assert held["clustered"] / draws > 0.92
    assert held["wilson"] / draws < 0.75


@pytest.mark.parametrize(
    ("values", "clusters"), [([1.0], [0]), ([1.0, 2.0], [0, 0]), ([1.0], [0, 1])]
)
def test_what_gives_no_interval_is_refused(values: list[float], clusters: list[int]) -> None:
    for interval in (clustered_mean, clustered_rate):
        with pytest.raises(InputError, match="no interval"):
            interval(values, clusters)
