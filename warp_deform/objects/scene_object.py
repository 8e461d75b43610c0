"""`SceneObject`: any of the objects that can stand in a scene; which of them has what is held."""

from __future__ import annotations

from collections.abc import Sequence

from .bag import Bag
from .box import Box
from .cable import Cable
from .cloth import Cloth

__all__ = ["box_of", "is_surface", "object_of"]  # `warp_deform.objects` has `SceneObject`

SceneObject = Cable | Box | Cloth | Bag
"""Where an object stands in the model, as `add_cable`, `add_box`, `add_cloth`, `add_bag` say."""


def object_of(objects: Sequence[SceneObject], particle: int | None, body: int | None) -> int:
    """Number among `objects` of the one that has a particle, or else a body, of their world.

    Raises:
        ValueError: none has it
    """
    for number, item in enumerate(objects):
        if item.body == body if isinstance(item, Box) else particle in item.particles:
            return number
    raise ValueError(f"no object has particle {particle} or body {body}")


def box_of(objects: Sequence[SceneObject], body: int) -> Box:
    """The box that is a body of their world.

    Raises:
        ValueError: none is
    """
    box = objects[object_of(objects, None, body)]
    assert isinstance(box, Box)
    return box


def is_surface(objects: Sequence[SceneObject], particle: int) -> bool:
    """Whether a particle is a vertex of a fabric or of a bag.

    Raises:
        ValueError: no object has it
    """
    return isinstance(objects[object_of(objects, particle, None)], Cloth | Bag)
