"""Checks of numbers that users hand in: wrong types and values out of range are refused by name."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any

import numpy as np

from ..errors import InputError

__all__ = [
    "BELOW_ONE",
    "COUNT",
    "NOT_NEGATIVE",
    "POSITIVE",
    "SHARE",
    "Interval",
    "check_fields",
    "check_number",
    "real_array",
]


@dataclass(frozen=True, kw_only=True)
class Interval:
    """Numbers from `low` to `high`, both included unless said otherwise; finite, too."""

    low: float = -math.inf
    high: float = math.inf
    above_low: bool = False
    """Whether `low` itself is left out."""
    below_high: bool = False
    """Whether `high` itself is left out."""
    whole: bool = False
    infinite: bool = False
    """Whether infinity is allowed, for limits that may be off."""

    def holds(self, value: object) -> bool:
        """Whether `value` is such a number; truth values, text and arrays are none."""
        if isinstance(value, bool) or not isinstance(value, Integral if self.whole else Real):
            return False
        number = float(value)
        return (
            (math.isfinite(number) or (self.infinite and number == math.inf))
            and (number > self.low if self.above_low else number >= self.low)
            and (number < self.high if self.below_high else number <= self.high)
        )

    def __str__(self) -> str:
        kind = "a whole number" if self.whole else "a number"
        if self.low == -math.inf and self.high == math.inf:
            return f"{kind} that is finite"
        if self.high == math.inf:
            return f"{kind} {'above' if self.above_low else 'of at least'} {self.low:g}"
        opening, closing = "(" if self.above_low else "[", ")" if self.below_high else "]"
        return f"{kind} in {opening}{self.low:g}, {self.high:g}{closing}"


POSITIVE = Interval(low=0.0, above_low=True)
NOT_NEGATIVE = Interval(low=0.0)
BELOW_ONE = Interval(low=0.0, high=1.0, below_high=True)
SHARE = Interval(low=0.0, high=1.0)
COUNT = Interval(low=1, whole=True)


def check_number(value: Any, name: str, allowed: Interval) -> float:
    """`value` as a float.

    Raises:
        InputError: it is no number in `allowed`.
    """
    if not allowed.holds(value):
        raise InputError(f"{name} must be {allowed}, got {_shown(value)}")
    return float(value)


def check_fields(config: Any, allowed: Mapping[str, Interval]) -> None:
    """Check the fields of a configuration by name.

    Raises:
        InputError: one of them is no number in its interval.
    """
    for name, interval in allowed.items():
        check_number(getattr(config, name), f"{type(config).__name__}.{name}", interval)


def real_array(
    values: Any, shape: tuple[int, ...], *, name: str, finite: bool = False
) -> np.ndarray:
    """`values` as a new float64 array of this shape.

    Args:
        finite: whether all of them have to be

    Raises:
        InputError: another shape, or no real numbers: text, objects, truth or complex values.
    """
    needed = f"{name}: {math.prod(shape)} numbers of shape {shape} are needed"
    try:
        array = np.asarray(values)
    except (TypeError, ValueError, RuntimeError) as error:
        raise InputError(f"{needed}, got {_shown(values)}") from error
    if array.dtype.kind not in "fiu":
        raise InputError(f"{needed}, got {_shown(values)} of type {array.dtype}")
    if array.shape != shape:
        raise InputError(f"{needed}, got shape {array.shape}")
    if finite and not np.isfinite(array).all():
        raise InputError(f"{needed}, all finite, got {_shown(array.tolist())}")
    return array.astype(np.float64)


def _shown(value: object) -> str:
    """A value as it is written, on one line and short."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else f"{text[:57]}..."
