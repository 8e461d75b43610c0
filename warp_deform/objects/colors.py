"""The paper's palette (Tableau) as 8-bit RGB."""

from __future__ import annotations

__all__ = [
    "BLUE",
    "BROWN",
    "CYAN",
    "GRAY",
    "GREEN",
    "ORANGE",
    "PINK",
    "PURPLE",
    "RED",
    "TABLE",
    "TARGET",
    "WHITE",
    "YELLOW",
    "Color",
]

Color = tuple[int, int, int]

BLUE: Color = (78, 121, 167)
RED: Color = (255, 87, 89)
GREEN: Color = (89, 169, 79)
ORANGE: Color = (242, 142, 43)
YELLOW: Color = (237, 201, 72)
PURPLE: Color = (176, 122, 161)
PINK: Color = (255, 157, 167)
CYAN: Color = (118, 183, 178)
BROWN: Color = (156, 117, 95)
GRAY: Color = (186, 176, 172)
WHITE: Color = (255, 255, 255)
TABLE: Color = (51, 51, 51)
TARGET: Color = (0, 255, 0)
