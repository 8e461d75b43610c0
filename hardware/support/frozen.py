"""Read-only arrays for frozen dataclasses, so that what is computed from them may be cached."""

from __future__ import annotations

import numpy as np

__all__ = ["freeze_arrays"]


def freeze_arrays(owner: object, *names: str) -> None:
    """Put copies in place of arrays of a frozen dataclass, float64, that cannot be written."""
    for name in names:
        array = np.array(getattr(owner, name), dtype=np.float64)
        array.flags.writeable = False
        object.__setattr__(owner, name, array)
