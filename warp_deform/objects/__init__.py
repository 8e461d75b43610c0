"""What is simulated and drawn: cables, boxes and zones, each with a frozen config."""

from .box import Box, BoxConfig, BoxPart, add_box, l_block
from .cable import Cable, CableConfig, RingConfig, add_cable, cable_line, cable_ring
from .cloth import Cloth, ClothConfig, add_cloth, cloth_sheet
from .cloth_mesh import add_cloth_mesh
from .push import Push
from .zone import Zone, ring_zone, segment_zone, square_zone

__all__ = ["Box", "BoxConfig", "BoxPart", "Cable", "CableConfig", "Cloth", "ClothConfig", "Push",
           "RingConfig", "Zone", "add_box", "add_cable", "add_cloth", "add_cloth_mesh",
           "cable_line", "cable_ring", "cloth_sheet", "l_block", "ring_zone", "segment_zone",
           "square_zone"]  # fmt: skip
