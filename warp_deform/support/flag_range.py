"""What numbers a flag takes, said where the flag is declared and checked before anything is opened.

    seed: Annotated[int, SEED] = 0

The command checks every verb's options, so a number that cannot be meant is one line and leaves
nothing behind.
"""

from __future__ import annotations

import typing
from dataclasses import dataclass, fields
from numbers import Integral
from typing import Any

from ..errors import InputError

__all__ = ["COUNT", "COUNT_OR_NONE", "SEED", "FlagRange", "check_flags", "check_seed", "flag_range"]


@dataclass(frozen=True)
class FlagRange:
    """Least and greatest value of a flag, or of each of its values, both allowed."""

    low: float
    high: float


SEED = FlagRange(0, 2**32 - 1)
"""Of NumPy's generators, as far as the numbers of episodes go."""
COUNT = FlagRange(1, 10**9)
"""Of episodes, steps, processes: one at least; nobody waits for more."""
COUNT_OR_NONE = FlagRange(0, COUNT.high)
"""The same where 0 means that there are none."""


def check_flags(options: Any) -> None:
    """Refuse options whose numbers are beyond their `FlagRange`.

    Args:
        options: a dataclass; None stands for a flag that was left out

    Raises:
        InputError: a value is less, greater or not a number
    """
    hints = typing.get_type_hints(type(options), include_extras=True)
    for field in fields(options):
        allowed = flag_range(hints[field.name])
        value = getattr(options, field.name)
        if allowed is None or value is None:
            continue
        for number in value if isinstance(value, tuple) else (value,):
            if not allowed.low <= number <= allowed.high:  # also when it is not a number
                flag = _flag(field.name, hints[field.name])
                raise InputError(
                    f"--{flag} is {number}; allowed: {allowed.low:.10g} to {allowed.high:.10g}"
                )


def check_seed(seed: int) -> int:
    """Return a seed, unchanged.

    Raises:
        InputError: it is none
    """
    if not isinstance(seed, Integral) or not SEED.low <= seed <= SEED.high:
        raise InputError(f"a seed is {SEED.low:.10g} to {SEED.high:.10g}, not {seed}")
    return seed


def _flag(name: str, hint: Any) -> str:
    """A field's name on the command line, without hyphens in front."""
    named = (getattr(extra, "name", None) for extra in getattr(hint, "__metadata__", ()))
    return next((each for each in named if each), name.replace("_", "-"))


def flag_range(hint: Any) -> FlagRange | None:
    """The range in a field's annotation, None where it has none."""
    extras = getattr(hint, "__metadata__", ())
    return next((extra for extra in extras if isinstance(extra, FlagRange)), None)
