"""The solver behind every task, as a Newton solver, with what it needs to be used.

The public names load on first use, so that reading a configuration loads neither Warp nor Newton.
The engine below it is `warp_deform.xpbd`.
"""

from __future__ import annotations

from ..support.lazy_exports import lazy_exports

_HOME = {
    "GuardLimits": "..xpbd.guards",
    "PhysicsError": "..xpbd.guards",
    "Problem": "..xpbd.guards",
    "ProblemKind": "..xpbd.guards",
    "SolverConfig": "..xpbd.config",
    "SolverFusedXPBD": ".solver",
    "WatchValues": "..xpbd.guards",
    "replay_bundle": "..xpbd.bundle",
}

__all__ = list(_HOME)

__getattr__ = lazy_exports(__name__, _HOME)
