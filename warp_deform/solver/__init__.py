"""The fused XPBD solver: one launch is many substeps, one thread is L worlds in SIMD lanes."""

from .bundle import replay_bundle
from .guards import GuardLimits, PhysicsError, Problem, ProblemKind, WatchValues
from .solver import SolverConfig, SolverFusedXPBD

__all__ = ["GuardLimits", "PhysicsError", "Problem", "ProblemKind", "SolverConfig",
           "SolverFusedXPBD", "WatchValues", "replay_bundle"]  # fmt: skip
