"""The verbs of the `warp-deform` command that train, evaluate, refine and convert."""
