"""What is simulated and drawn: cables, fabrics, bags, boxes and zones, each with a config."""

from .bag import Bag, BagConfig, add_bag, add_bag_mesh, bag_shell
from .box import Box, BoxConfig, BoxPart, add_box, l_block
from .cable import Cable, CableConfig, RingConfig, add_cable, cable_line, cable_ring
from .cloth import Cloth, ClothConfig, add_cloth, cloth_sheet
from .cloth_mesh import add_cloth_mesh
from .push import Push
from .scene_object import SceneObject
from .zone import Zone, ring_zone, segment_zone, square_zone

__all__ = [
    "Bag",
    "BagConfig",
    "Box",
    "BoxConfig",
    "BoxPart",
    "Cable",
    "CableConfig",
    "Cloth",
    "ClothConfig",
    "Push",
    "RingConfig",
    "SceneObject",
    "Zone",
    "add_bag",
    "add_bag_mesh",
    "add_box",
    "add_cable",
    "add_cloth",
    "add_cloth_mesh",
    "bag_shell",
    "cable_line",
    "cable_ring",
    "cloth_sheet",
    "l_block",
    "ring_zone",
    "segment_zone",
    "square_zone",
]
