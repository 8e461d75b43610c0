"""95 % intervals of episodes in clusters: ten tosses at each of ten goals are not a hundred goals.

What is easy at one toss of a goal is easy at the next, so an interval that takes every episode as
an independent one is too narrow. Here the spread is that of the clusters, and Student's t has one
degree of freedom less than there are clusters. With one episode a cluster all is as usual: Wilson's
interval, and the mean's with t.

Source: the variance of a ratio by its clusters, Cochran, "Sampling techniques", 1977, section 6.5;
the effective sample size with its correction for few clusters, Korn and Graubard, Survey
Methodology 24, 1998; Wilson's interval with it, Dean and Pagano, Journal of Survey Statistics and
Methodology 3, 2015.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence

import numpy as np
from scipy import stats

from warp_deform.errors import InputError

__all__ = ["clustered_mean", "clustered_rate"]

_SIDE = 0.975


def clustered_mean(values: Sequence[float], clusters: Sequence[Hashable]) -> tuple[float, float]:
    """Return the mean of values (n,) and the half width of its interval.

    Args:
        values: what was measured, any number of them in each cluster
        clusters: which cluster each is of, (n,)

    Raises:
        InputError: another number of clusters' names than of values, or fewer than two clusters
    """
    y, owner = _clustered(values, clusters)
    return float(y.mean()), _t(owner.max()) * math.sqrt(_variance(y, owner))


def clustered_rate(successes: Sequence[bool], clusters: Sequence[Hashable]) -> tuple[float, float]:
    """Return the ends of the interval of a success rate [%].

    It is Wilson's, of as many independent episodes as would tell as much. Where all succeeded, or
    none, nothing tells how much alike a cluster's are, and each cluster counts as one.

    Args:
        successes: whether each episode succeeded, (n,)
        clusters: which cluster each is of, (n,)

    Raises:
        InputError: see `clustered_mean`
    """
    y, owner = _clustered(successes, clusters)
    n, count, rate = len(y), int(owner.max()) + 1, float(y.mean())
    if rate in (0.0, 1.0):
        return _wilson(rate, count)
    alone = rate * (1.0 - rate) / (n - 1)
    effect = max(_variance(y, owner) / alone, 1.0)
    return _wilson(rate, n / effect * (_t(n - 1) / _t(count - 1)) ** 2)


def _clustered(
    values: Sequence[float], clusters: Sequence[Hashable]
) -> tuple[np.ndarray, np.ndarray]:
    """Values (n,) as floats, and the number of the cluster of each."""
    numbers = {name: i for i, name in enumerate(dict.fromkeys(clusters))}
    if len(values) != len(clusters) or len(numbers) < 2:
        raise InputError(
            f"{len(values)} values of {len(clusters)} episodes in {len(numbers)} clusters give no "
            "interval; name a cluster for each, two or more in all"
        )
    return np.array(values, dtype=float), np.array([numbers[name] for name in clusters])


def _variance(y: np.ndarray, owner: np.ndarray) -> float:
    """Of the mean, by how much the clusters' sums differ from what it makes of them."""
    count = int(owner.max()) + 1
    left = np.bincount(owner, weights=y - y.mean(), minlength=count) / len(y)
    return float(count / (count - 1) * (left**2).sum())


def _t(degrees: int) -> float:
    return float(stats.t.ppf(_SIDE, degrees))


def _wilson(rate: float, n: float) -> tuple[float, float]:
    """Wilson's interval [%]; n need not be whole."""
    z = float(stats.norm.ppf(_SIDE))
    middle = (rate + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * math.sqrt(rate * (1 - rate) / n + z**2 / (4 * n**2))
    return 100 * max(middle - half, 0.0), 100 * min(middle + half, 1.0)
