"""Policies learned from demonstrations: data, agents, training and evaluation.

Every name has one import path, its own module: `training.train` makes a run's folder,
`evaluation.run.evaluate_run` tests it, `policy.policy.load_policy` acts. The package depends on
`warp_deform` and never the other way round; importing it loads neither torch nor Warp.
"""

__all__: list[str] = []
