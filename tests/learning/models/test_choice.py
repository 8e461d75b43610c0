"""The pick that is chosen: probable, and sure of its place; and no more work than that takes."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from learning.models.choice import choose

ROWS, COLUMNS = 24, 16
SPREAD = torch.zeros(1, ROWS, COLUMNS)
"""Place logits of a network that has no idea."""


def peak(*at: int, rotations: int = 1) -> Tensor:
    """Place logits of a network that is sure."""
    logits = torch.zeros(rotations, ROWS, COLUMNS)
    logits[at] = 20.0
    return logits


def heat(**probabilities: float) -> Tensor:
    """Pick logits: so much at pixels named `r3c4`, evenly little elsewhere."""
    share = (1 - sum(probabilities.values())) / (ROWS * COLUMNS - len(probabilities))
    likely = torch.full((ROWS, COLUMNS), share)
    for name, probability in probabilities.items():
        row, column = name[1:].split("c")
        likely[int(row), int(column)] = probability
    return likely.log() + 3.0  # logits are probabilities' logarithms but for a constant


class Places:
    """Place logits by picks, and the picks that were asked for."""

    def __init__(self, sure: dict[tuple[int, int], Tensor]) -> None:
        self.sure, self.asked = sure, []

    def __call__(self, pick: Tensor) -> Tensor:
        self.asked.append(tuple(pick.tolist()))
        return self.sure.get(self.asked[-1], SPREAD)


def test_a_pick_that_is_sure_of_its_place_wins() -> None:
    seen = heat(r3c4=0.5, r20c10=0.4)
    places = Places({(20, 10): peak(2, 7, 5, rotations=3)})
    choice = choose(seen, places, picks=2)
    assert choice.pick.tolist() == [20, 10]
    assert (choice.rotation, choice.place.tolist()) == (2, [7, 5])
    assert choose(seen, places, picks=1).pick.tolist() == [3, 4]


def test_one_is_enough_where_the_network_is_sure() -> None:
    places = Places({(3, 4): peak(0, 7, 5)})
    choose(heat(r3c4=0.6, r20c10=0.3), places, picks=5)
    assert places.asked == [(3, 4)]
    unsure = Places({})
    choose(heat(r3c4=0.6, r20c10=0.3), unsure, picks=5)
    assert unsure.asked[:2] == [(3, 4), (20, 10)]


def test_neighbours_are_the_same_pick() -> None:
    places = Places({})
    choose(heat(r3c4=0.3, r4c5=0.2, r5c6=0.1, r3c7=0.1), places, picks=2)
    assert places.asked == [(3, 4), (3, 7)]


def test_what_is_avoided_is_not_picked() -> None:
    seen = torch.full((ROWS, COLUMNS), -math.inf)
    seen[0, 15], seen[23, 0] = 1.0, 0.5
    places = Places({(23, 0): peak(0, 7, 5)})
    assert choose(seen, places, picks=9).pick.tolist() == [23, 0]
    assert places.asked == [(0, 15), (23, 0)]


@pytest.mark.parametrize("seed", range(5))
def test_nothing_better_is_passed_over(seed: int) -> None:
    """Among the picks that may be weighed, all looked at."""
    rng = np.random.default_rng(seed)
    seen = torch.from_numpy(3 * rng.normal(size=(ROWS, COLUMNS)).astype(np.float32))
    maps = torch.from_numpy(
        8 * rng.normal(size=(ROWS, COLUMNS, 2, ROWS, COLUMNS)).astype(np.float32)
    )
    left, worth = seen.flatten().log_softmax(0).view(ROWS, COLUMNS), {}
    for _ in range(4):
        row, column = divmod(int(left.argmax()), COLUMNS)
        likely = maps[row, column].flatten().softmax(0).view(2, ROWS, COLUMNS).numpy()
        padded = np.pad(likely, ((0, 0), (2, 2), (2, 2)))
        near = np.lib.stride_tricks.sliding_window_view(padded, (5, 5), axis=(1, 2))
        worth[row, column] = float(left[row, column].exp()) * near.sum(axis=(-2, -1)).max()
        left[max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3] = -math.inf
    choice = choose(seen, lambda pick: maps[tuple(pick.tolist())], picks=4)
    best = max(worth, key=worth.__getitem__)
    assert tuple(choice.pick.tolist()) == best
    rotation, place = divmod(int(maps[best].argmax()), ROWS * COLUMNS)
    assert (choice.rotation, choice.place.tolist()) == (rotation, list(divmod(place, COLUMNS)))
