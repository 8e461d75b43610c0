"""The refusal of measurements that do not fit together, which names the one to take again."""

from __future__ import annotations

from warp_deform.errors import InputError

__all__ = ["PoorFit"]


class PoorFit(InputError):
    """Measurements do not fit together well enough; the message is one line.

    Attributes:
        worst: index of the one to measure again first; None where they do not tell which
    """

    def __init__(self, message: str, *, worst: int | None) -> None:
        self.worst = worst
        super().__init__(message)
