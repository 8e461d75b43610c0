"""When the springs of a chain are solved together, and not one after the other.

One pass over the springs a substep leaves none of them stiffer than about m / dt^2, however stiff
it is meant to be: to its compliance 1 / k comes dt^2 / m.
"""

from __future__ import annotations

from ..errors import InputError

__all__ = ["SOLVES", "check_solve", "too_heavy", "too_stiff"]

SOLVES = ("direct", "gauss-seidel")
_DT = 1 / 1200  # [s] the solver's default substep
_GRAVITY = 9.81  # [m/s^2]
_STRAIN = 0.02
_SHARE = 0.1


def check_solve(name: str, value: str) -> None:
    """Check that the option `name` is one of `SOLVES`.

    Raises:
        InputError: it is not.
    """
    if value not in SOLVES:
        raise InputError(f"{name} must be one of {', '.join(SOLVES)}, got {value!r}")


def too_heavy(count: int, spacing: float) -> bool:
    """Whether the weight of a chain of `count` particles, hung by its end, would stretch its first
    spring by more than 2 % beyond what its stiffness allows, when solved one after the other.

    That strain is count g dt^2 / spacing: the mass cancels.
    """
    return count * _GRAVITY * _DT**2 / spacing > _STRAIN


def too_stiff(stiffness: float, mass: float) -> bool:
    """Whether such springs [N/m] between such particles [kg] would be softer by more than a tenth:
    k dt^2 / m is the share. A `mass` of 0 is pinned.
    """
    return stiffness * _DT**2 > _SHARE * mass
