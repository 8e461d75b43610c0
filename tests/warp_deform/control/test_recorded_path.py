"""Recorded paths, walked faster and smoothed; what is better than a recording, and what is not."""

from __future__ import annotations

import numpy as np
import pytest

from warp_deform.control.recorded_path import (
    RecordedPath,
    Stretch,
    cut,
    hats,
    roughness,
    walked,
)
from warp_deform.control.trajectory_measures import LEAST_LOSS, Measures, Walk

STRIDE = 0.05


def recorded() -> RecordedPath:
    """Across in the air, a take, a slow carry with a corner, and up again."""
    legs = [(0.3, 0, 0, 10), (0, 0, -0.2, 5), (0, 0.1, 0, 14), (0.06, 0, 0, 9), (0, 0, 0.1, 4)]
    steps = [np.tile([x / n, y / n, z / n, 0.0], (n, 1)) for x, y, z, n in legs]
    targets = np.concatenate([[[0.4, 0.0, 0.3, 0.0]], np.concatenate(steps)]).cumsum(axis=0)
    ends = [(0, 15, False), (15, 38, True), (38, 42, False)]
    return RecordedPath(targets, tuple(Stretch(*end) for end in ends))


def test_a_path_at_its_own_pace_stays_as_it_was() -> None:
    path = recorded()
    same = walked(path, free=1.0, held=1.0, smoothing=0.0, stride=STRIDE)
    assert same.steps == path.steps
    assert np.allclose(same.targets, path.targets, atol=1e-12)


def test_takes_and_releases_keep_their_places_and_no_step_is_too_long() -> None:
    path = recorded()
    for smoothing in (0.0, 3.0):
        fast = walked(path, free=3.0, held=6.0, smoothing=smoothing, stride=STRIDE)
        assert fast.steps < path.steps / 2
        for old, new in zip(path.stretches, fast.stretches, strict=True):
            assert np.allclose(path.targets[old.last], fast.targets[new.last], atol=1e-12)
        if not smoothing:
            ways = np.linalg.norm(np.diff(fast.targets[:, :3], axis=0), axis=1)
            assert ways.max() <= STRIDE * (1 + 1e-3)


def test_smoothing_makes_a_path_smoother() -> None:
    path = recorded()
    rough = [
        roughness(np.diff(walked(path, free=1, held=1, smoothing=w, stride=STRIDE).targets, axis=0))
        for w in (0.0, 0.3, 3.0)
    ]
    assert rough[0] > rough[1] > rough[2]


def test_roughness_goes_from_rest_to_rest_and_leaves_the_hold_out() -> None:
    actions = np.array([[0.5, 0, 0, -1], [0.5, 0, 0, 1], [0, 1.0, 0, 1]])
    assert roughness(actions) == pytest.approx(0.25 + 0 + 1.25 + 1.0)


def test_displacements_begin_with_nothing_and_end_at_the_last_knot() -> None:
    shares = hats(9, 3)
    assert np.allclose(shares[0], 0) and np.allclose(shares[-1], [0, 0, 1])
    assert np.allclose(shares[3:].sum(axis=1), 1)
    assert cut([True, True, False]) == [(0, 2, True), (2, 3, False)]


def walk(
    steps: int = 10, loss: float = 0.01, rough: float = 1.0, *, rests: bool = True, score: float = 1
) -> Walk:
    return Walk(np.zeros((steps, 4)), Measures(steps, loss, rough), 0, rests, score)


@pytest.mark.parametrize(
    "tried",
    [
        walk(),  # the same
        walk(steps=2, loss=0.011),  # let go early, less exact
        walk(steps=2, rests=False),  # solved while it moves, not at rest
        walk(steps=2, score=0.9),
        walk(loss=0.001, rough=1.1),
        walk(steps=11, loss=0.001),
        Walk(np.zeros((2, 4)), None, 0, True, 1.0),  # a guard has fired
    ],
)
def test_what_is_worse_in_any_respect_does_not_beat_the_recording(tried: Walk) -> None:
    assert not tried.beats(walk())


def test_what_is_better_in_one_respect_and_worse_in_none_does() -> None:
    for better in (walk(steps=9), walk(loss=0.009), walk(rough=0.9), walk(9, 0.005, 0.5)):
        assert better.beats(walk())
    # below the least loss there is nothing to win and nothing to lose
    assert walk(steps=9, loss=LEAST_LOSS).beats(walk(loss=LEAST_LOSS / 10))
    assert not walk(loss=LEAST_LOSS / 10).beats(walk(loss=LEAST_LOSS))
