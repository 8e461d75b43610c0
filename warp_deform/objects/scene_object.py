"""`SceneObject`: any of the objects that can stand in a scene and be simulated."""

from __future__ import annotations

from .bag import Bag
from .box import Box
from .cable import Cable
from .cloth import Cloth

__all__: list[str] = []  # `warp_deform.objects` is the import path of what is here

SceneObject = Cable | Box | Cloth | Bag
"""Where an object stands in the model, as `add_cable`, `add_box`, `add_cloth`, `add_bag` say."""
