"""The cable task on a Franka arm: what will calibrate, collect, run and score stands here.

Nothing public yet. The package depends on `warp_deform` and never the other way round; importing it
loads no vendor's library and opens no device.
"""

__all__: list[str] = []
