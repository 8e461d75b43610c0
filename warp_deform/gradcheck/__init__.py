"""Checks of the solver's derivatives against finite differences, in states of real episodes.

The names load on first use, so that reading the configuration loads no simulator.
"""

from __future__ import annotations

from ..support.lazy_exports import lazy_exports

_HOME = {
    "GradcheckConfig": ".config",
    "Row": ".report",
    "Summary": ".summary",
    "check": ".report",
    "summarise": ".summary",
    "wrong": ".report",
}

__all__ = list(_HOME)

__getattr__ = lazy_exports(__name__, _HOME)
