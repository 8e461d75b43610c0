"""Contact and friction between particles and boxes, two-way."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..contact.friction import friction
from ..contact.table_support import table_support
from ..lanes.algebra import add, mul, sub  # noqa: F401  (operators are found by name)
from ..lanes.structures import structures
from .overlap_recovery import overlap_recovery
from .rigid_body import rigid_body

__all__ = ["box_particle"]

CARRIED = 1.0e-4
"""A particle this close to where it lies on the table is carried by it [m]."""
STEEP = 0.7
"""A normal with this much downwards pushes onto the table: a flatter one squeezes out sideways."""


@functools.cache
def box_particle(scalar: Any, lanes: int) -> SimpleNamespace:
    """`project_box_particle`: one particle of one lane against one box.

    The normal is that of the nearest point of the box; for a centre inside the box, that of the
    nearest face. Separation is limited as in `overlap_recovery`.

    A particle that the table carries does not give way downwards (`stands` is 0): the box would
    sink through light fabric, as the table takes back only afterwards what a contact of very
    unequal masses gives to the particle. It is given the correction all the same, so that the load
    passes on to the table and its friction, see `table_support`. `particle_gap` is the distance of
    a point from a box.
    """
    t = structures(scalar, lanes)
    S, R3 = t.S, t.R3
    Shapes, Particles, Bodies = t.Shapes, t.Particles, t.Bodies
    body = rigid_body(scalar, lanes)
    response, apply_impulse, moved = body.response, body.apply_impulse, body.moved
    coulomb_scalar = friction(scalar, lanes).coulomb_scalar
    raised = table_support(scalar, lanes).raised
    correction = overlap_recovery(scalar).correction

    @wp.func
    def particle_gap(p: R3, shape: int, b: int, shapes: Shapes, bodies: Bodies):
        """Distance of a point from a box [m]; 0 inside."""
        h = shapes.half[shape]
        away = wp.quat_rotate_inv(bodies.q[b], p - bodies.x[b]) - shapes.center[shape]
        at = wp.quat_rotate_inv(shapes.rotation[shape], away)
        return wp.length(
            R3(
                wp.max(wp.abs(at[0]) - h[0], S(0.0)),
                wp.max(wp.abs(at[1]) - h[1], S(0.0)),
                wp.max(wp.abs(at[2]) - h[2], S(0.0)),
            )
        )

    @wp.func
    def stands(z: S, radius: S, down: S):
        """0 for a particle at height z that the table carries and a push downwards, else 1."""
        return wp.where(down < -S(STEEP) and z < radius + S(CARRIED), S(0.0), S(1.0))

    @wp.func
    def project_box_particle(
        i: int,
        lane: int,
        radius: S,
        shape: int,
        b: int,
        mu: S,
        max_recovery: S,
        particles: Particles,
        shapes: Shapes,
        bodies: Bodies,
    ):
        px = particles.x[i]
        p = raised(R3(px.x[lane], px.y[lane], px.z[lane]), radius)
        h = shapes.half[shape]
        # the particle in the box's own frame
        away = wp.quat_rotate_inv(bodies.q[b], p - bodies.x[b]) - shapes.center[shape]
        at = wp.quat_rotate_inv(shapes.rotation[shape], away)
        near = R3(
            wp.clamp(at[0], -h[0], h[0]), wp.clamp(at[1], -h[1], h[1]), wp.clamp(at[2], -h[2], h[2])
        )
        n = at - near
        gap = wp.length(n)
        if gap < radius:
            if gap > S(1.0e-8):
                n = n / gap
            else:
                ox = wp.abs(at[0]) - h[0]
                oy = wp.abs(at[1]) - h[1]
                oz = wp.abs(at[2]) - h[2]
                gap = wp.max(ox, wp.max(oy, oz))
                if ox >= oy and ox >= oz:
                    n = R3(wp.sign(at[0]), S(0.0), S(0.0))
                elif oy >= oz:
                    n = R3(S(0.0), wp.sign(at[1]), S(0.0))
                else:
                    n = R3(S(0.0), S(0.0), wp.sign(at[2]))
            local = shapes.center[shape] + wp.quat_rotate(shapes.rotation[shape], near)
            r = wp.quat_rotate(bodies.q[b], local)
            n = wp.quat_rotate(bodies.q[b], wp.quat_rotate(shapes.rotation[shape], n))
            po = particles.xp[i]
            step = p - R3(po.x[lane], po.y[lane], po.z[lane]) - moved(b, bodies, local)
            approach = wp.dot(step, n)
            depth = correction(radius - gap, approach, max_recovery)
            wv = particles.w[i]
            wi = wv[lane]
            across = wi + response(b, bodies, r, n)
            w = wi * stands(p[2], radius, n[2]) + response(b, bodies, r, n)
            if w > S(0.0):
                slip = step - n * approach
                budget = depth * mu * shapes.friction[shape] * across / w
                along = n * (depth / w)
                drag = slip * (coulomb_scalar(wp.dot(slip, slip), budget) / across)
                given = (along - drag) * wi
                px.x[lane] = px.x[lane] + given[0]
                px.y[lane] = px.y[lane] + given[1]
                px.z[lane] = px.z[lane] + given[2]
                particles.x[i] = px
                apply_impulse(b, bodies, r, drag - along)
            bodies.touching[b] = bodies.touching[b] + 1
            bodies.support[b] = bodies.support[b] + 1

    return SimpleNamespace(
        project_box_particle=project_box_particle, particle_gap=particle_gap, stands=stands
    )
