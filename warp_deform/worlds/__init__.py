"""Episodes of one task side by side: their state, their actions, what is seen of them.

`Worlds` loads on first use, so that reading a task loads neither Warp nor Newton.
"""

from __future__ import annotations

from ..support.handed_on import hand_on

_HOME = {
    "Worlds": ".worlds",
}

__all__ = list(_HOME)

__getattr__ = hand_on(__name__, _HOME)
