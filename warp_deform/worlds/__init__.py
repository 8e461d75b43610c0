"""Episodes of one task side by side: their state, their actions, what is seen of them.

`Worlds` loads on first use, so that reading a task loads neither Warp nor Newton.
"""

from __future__ import annotations

from ..support.lazy_exports import lazy_exports

_HOME = {
    "TipControl": ".tip_control",
    "Worlds": ".worlds",
}

__all__ = list(_HOME)

__getattr__ = lazy_exports(__name__, _HOME)
