"""The fused XPBD solver: one launch is many substeps, one thread is L worlds in SIMD lanes.

The public names load on first use, so that reading a configuration loads neither Warp nor Newton.
"""

from __future__ import annotations

import importlib

_HOME = {
    "GuardLimits": "guards",
    "PhysicsError": "guards",
    "Problem": "guards",
    "ProblemKind": "guards",
    "SolverConfig": "config",
    "SolverFusedXPBD": "solver",
    "WatchValues": "guards",
    "replay_bundle": "bundle",
}

__all__ = list(_HOME)


def __getattr__(name: str) -> object:
    """Load a public name's module when the name is first asked for (PEP 562)."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f".{_HOME[name]}", __name__), name)
    globals()[name] = value
    return value
