"""cable-line-notarget: straighten a cable where a goal image shows it.

Source: Seita et al., ICRA 2021, appendix on cable-line-notarget.
"""

from __future__ import annotations

from .cable_shape import CableShapeNotarget

__all__ = ["CableLineNotarget"]


class CableLineNotarget(CableShapeNotarget):
    """cable-shape-notarget with one side: the goal is a straight line."""

    name = "cable-line-notarget"
    instruction = "Lay the cable straight as in the goal picture."
    sides = (1,)
