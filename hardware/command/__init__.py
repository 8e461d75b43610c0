"""The verbs of `warp-deform franka`."""
