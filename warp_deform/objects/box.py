"""Rigid boxes, and bodies made of several boxes such as the L-block.

Source: Seita et al., ICRA 2021 (sizes, masses, friction). The original gives every body a
placeholder inertia; here it is that of the solid boxes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from ..support.checked import NOT_NEGATIVE, POSITIVE, check_fields, real_array
from ..support.quaternion import quat_from_yaw
from .attributes import register_attributes
from .colors import RED, Color

if TYPE_CHECKING:
    import newton

__all__: list[str] = []  # `warp_deform.objects` is the import path of what is here


@dataclass(frozen=True)
class BoxPart:
    """One box of a body: size (x, y, z) [m] and where its centre is in the body's frame [m]."""

    size: tuple[float, float, float]
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        real_array(self.offset, (3,), name="BoxPart.offset", finite=True)
        if not (real_array(self.size, (3,), name="BoxPart.size", finite=True) > 0).all():
            raise InputError(f"BoxPart.size: every side must be above 0, got {self.size}")


@dataclass(frozen=True, kw_only=True)
class BoxConfig:
    """A rigid body made of boxes; the default is the 4 cm cube of fabric-cover."""

    parts: tuple[BoxPart, ...] = (BoxPart((0.04, 0.04, 0.04)),)
    mass: float = 0.01
    """Mass of the whole body [kg], spread evenly over the parts' volumes."""
    friction: float = 1.0
    """Factor on the solver's Coulomb coefficients, for the table, particles and bodies."""
    color: Color = RED

    def __post_init__(self) -> None:
        if not isinstance(self.parts, tuple) or not self.parts:
            raise InputError(f"BoxConfig.parts must be one BoxPart or more, got {self.parts!r}")
        for part in self.parts:
            if not isinstance(part, BoxPart):
                raise InputError(f"BoxConfig.parts must be BoxPart, got {part!r}")
        check_fields(self, {"mass": POSITIVE, "friction": NOT_NEGATIVE})

    @property
    def lowest(self) -> float:
        """Lowest point of the upright body in its own frame [m] (negative)."""
        return min(part.offset[2] - part.size[2] / 2 for part in self.parts)

    def inertia(self) -> tuple[np.ndarray, np.ndarray]:
        """Centre of mass (3,) [m] and inertia about it (3, 3) [kg m^2], in the body's frame."""
        volume = np.array([np.prod(part.size) for part in self.parts])
        masses = self.mass * volume / volume.sum()
        offsets = np.array([part.offset for part in self.parts], dtype=float)
        centre = masses @ offsets / self.mass
        tensor = np.zeros((3, 3))
        for part, mass, offset in zip(self.parts, masses, offsets - centre, strict=True):
            square = np.square(part.size)
            tensor += mass / 12 * np.diag(square.sum() - square)
            tensor += mass * (offset @ offset * np.eye(3) - np.outer(offset, offset))
        return centre, tensor


def l_block() -> BoxConfig:
    """The L-block of block-notarget; its second part is 0.1 mm lower, as in the original."""
    return BoxConfig(
        parts=(
            BoxPart((0.08, 0.03, 0.04), (0.025, 0.0, 0.0)),
            BoxPart((0.03, 0.08, 0.0399), (0.0, 0.025, 0.0)),
        ),
        mass=0.1,
        friction=0.3,
    )


@dataclass(frozen=True)
class Box:
    """Where a rigid body stands in the model; numbers are relative to its world."""

    config: BoxConfig
    body: int
    shapes: range


def add_box(
    builder: newton.ModelBuilder,
    config: BoxConfig,
    position: tuple[float, float, float],
    *,
    yaw: float = 0.0,
) -> Box:
    """Add a rigid body at `position` [m], turned by `yaw` [rad] about the vertical axis."""
    import newton
    import warp as wp

    if not np.isfinite([*position, yaw]).all():
        raise InputError(f"a box needs a finite pose, got {position}, yaw {yaw}")
    register_attributes(builder)
    centre, tensor = config.inertia()
    body = builder.add_body(
        xform=wp.transform(wp.vec3(*position), wp.quat(*quat_from_yaw(yaw).tolist())),
        com=wp.vec3(*centre),
        inertia=wp.mat33(*tensor.flatten()),
        mass=config.mass,
        lock_inertia=True,
    )
    first = builder.shape_count
    for part in config.parts:
        hx, hy, hz = (side / 2 for side in part.size)
        builder.add_shape_box(
            body,
            xform=wp.transform(wp.vec3(*part.offset), wp.quat_identity()),
            hx=hx,
            hy=hy,
            hz=hz,
            cfg=newton.ModelBuilder.ShapeConfig(density=0.0, mu=config.friction),
            color=wp.vec3(*(channel / 255 for channel in config.color)),
        )
    return Box(config, body, range(first, builder.shape_count))
