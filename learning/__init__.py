"""Policies learned from demonstrations: what will train, evaluate and report stands here.

Nothing public yet. The package depends on `warp_deform` and never the other way round; importing it
loads neither torch nor Warp.
"""

__all__: list[str] = []
