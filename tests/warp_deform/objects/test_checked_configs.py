"""Every configuration of objects and solver names a wrong value and what is allowed."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest

from warp_deform.errors import InputError
from warp_deform.objects import (
    BagConfig,
    BoxConfig,
    BoxPart,
    CableConfig,
    ClothConfig,
    RingConfig,
    Zone,
)
from warp_deform.solver import GuardLimits, SolverConfig
from warp_deform.support.checked import Interval, check_number

CONFIGS = (CableConfig, RingConfig, ClothConfig, BagConfig, BoxConfig, SolverConfig, GuardLimits)
NUMBERS = [
    (config, field.name)
    for config in CONFIGS
    for field in fields(config)
    if isinstance(getattr(config(), field.name), int | float)
    and not isinstance(getattr(config(), field.name), bool)
]
NO_NUMBERS = ["0.1", None, 1j, True, [0.1], np.array([0.1]), np.nan, -np.inf, -1.0]


@pytest.mark.parametrize(
    ("config", "name"), NUMBERS, ids=lambda value: getattr(value, "__name__", value)
)
def test_every_number_is_checked_by_name(config, name):
    for value in NO_NUMBERS:
        with pytest.raises(InputError, match=f"{config.__name__}.{name} must be a") as caught:
            config(**{name: value})
        assert "\n" not in str(caught.value) and "got" in str(caught.value)


@pytest.mark.parametrize(
    ("config", "name"),
    [
        (CableConfig, "beads"),
        (RingConfig, "beads"),
        (ClothConfig, "rows"),
        (ClothConfig, "columns"),
    ],
)
def test_counts_are_whole(config, name):
    for value in (2.5, 4.0, 1, 0, np.float32(8)):
        with pytest.raises(InputError, match=f"{name} must be a whole number of at least"):
            config(**{name: value})
    assert getattr(config(**{name: np.int64(8)}), name) == 8


def test_defaults_and_numbers_of_numpy_are_allowed():
    for config in CONFIGS:
        config()
    assert CableConfig(mass=np.float32(0.2)).mass == np.float32(0.2)
    assert SolverConfig(max_speed=np.inf).max_speed == np.inf


@pytest.mark.parametrize("size", [(0.04, 0.04), "big", (0.04, 0.0, 0.04), (0.1, np.inf, 0.1), None])
def test_sides_of_boxes_are_checked(size):
    with pytest.raises(InputError, match=r"BoxPart\.size"):
        BoxPart(size)


@pytest.mark.parametrize("parts", [(), None, [BoxPart((1, 1, 1))], ("part",)], ids=repr)
def test_parts_of_boxes_are_checked(parts):
    with pytest.raises(InputError, match=r"BoxConfig\.parts"):
        BoxConfig(parts=parts)


@pytest.mark.parametrize("corners", ["square", np.zeros((4, 3)), np.full((1, 4, 3), np.nan)])
def test_corners_of_zones_are_checked(corners):
    with pytest.raises(InputError, match=r"Zone\.corners"):
        Zone(corners)


@pytest.mark.parametrize(
    ("interval", "text"),
    [
        (Interval(low=0.0, above_low=True), "a number above 0"),
        (Interval(low=3, whole=True), "a whole number of at least 3"),
        (Interval(low=0.0, high=1.0, below_high=True), r"a number in \[0, 1\)"),
        (Interval(), "a number that is finite"),
    ],
)
def test_an_interval_says_what_it_holds(interval, text):
    with pytest.raises(InputError, match=f"size must be {text}, got 'x'"):
        check_number("x", "size", interval)
