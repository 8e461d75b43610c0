"""Particles on the table (the plane z = 0), and the velocity update that ends a substep."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..lanes.algebra import add, any_less, div, dot, less, mul, root, select, sub  # noqa: F401
from ..lanes.structures import structures
from ..lanes.tape import Kind
from .friction import friction, friction_adjoint

__all__ = ["table_contact", "table_contact_adjoint"]


@functools.cache
def table_contact(
    scalar: Any, lanes: int, with_sheets: bool = False, taped: bool = False
) -> SimpleNamespace:
    """`predict` begins a substep for a particle, `finish` ends it.

    `finish` pushes the particle out of the table, applies Coulomb friction to its horizontal step,
    and derives the velocity. It returns the squared length of the whole step [m^2] before clamping.

    `stepped` is the whole step: the predicted one and what constraints have changed since. It is
    not taken as the difference of two positions, which far from the origin is as coarse as they
    are: the predicted position is rounded the same way twice, so what nothing touched keeps its
    velocity. `taped`, `finish` leaves it and the height on the tape (with fabrics: the position,
    that at the start of the substep, and the old velocity).
    """
    t = structures(scalar, lanes)
    S, V, V3, Particles, Tape = t.S, t.V, t.V3, t.Particles, t.Tape
    coulomb = friction(scalar, lanes).coulomb

    @wp.func
    def predict(i: int, damped_dt: V, fall: V3, particles: Particles):
        x = particles.x[i]
        particles.xp[i] = x
        particles.x[i] = x + (particles.v[i] + fall) * select(particles.w[i], damped_dt, V(S(0.0)))

    @wp.func
    def finish(
        i: int,
        at: int,
        at_height: int,
        radius: S,
        inverse_dt: S,
        damped_dt: V,
        fall: V3,
        mu: V,
        fastest: V,
        all_on: bool,
        on: V,
        particles: Particles,
        tape: Tape,
    ):
        x = particles.x[i]
        o = particles.xp[i]
        zero = V(S(0.0))
        # as `stepped` says, and written out, for what is no longer inlined costs half as much again
        old = particles.v[i]
        d = (old + fall) * select(particles.w[i], damped_dt, zero)
        d = d + (x - (o + d))
        if wp.static(taped and with_sheets):
            tape.x[at] = x
            tape.x[at + 1] = o
            tape.x[at + 2] = old
        elif wp.static(taped):
            tape.x[at] = d
            tape.v[at_height] = x.z
        if any_less(x.z, radius):
            depth = select(particles.w[i], wp.max(V(radius) - x.z, zero), zero)
            f = coulomb(d.x * d.x + d.y * d.y, depth * mu)
            back = V3(zero - d.x * f, zero - d.y * f, depth)
            x = x + back
            d = d + back
        moved2 = dot(d, d)
        v = d * inverse_dt
        # divide only where the clamp may act; fastest [m] is the longest step allowed
        if any_less(fastest * fastest - moved2, S(0.0)):
            v = v * wp.min(V(S(1.0)), fastest / wp.max(root(moved2), V(S(1.0e-12))))
        if not all_on:
            x = V3(select(on, x.x, o.x), select(on, x.y, o.y), select(on, x.z, o.z))
            v = V3(select(on, v.x, old.x), select(on, v.y, old.y), select(on, v.z, old.z))
            moved2 = moved2 * on
        particles.x[i] = x
        particles.v[i] = v
        return moved2

    @wp.func
    def stepped(x: V3, o: V3, w: V, v: V3, damped_dt: V, fall: V3):
        """Step from o to x of a particle whose velocity was v before."""
        d = (v + fall) * select(w, damped_dt, V(S(0.0)))
        return d + (x - (o + d))

    return SimpleNamespace(predict=predict, stepped=stepped, finish=finish)


@functools.cache
def table_contact_adjoint(scalar: Any, lanes: int, with_sheets: bool = False) -> SimpleNamespace:
    """`sweep_finish` takes the end of a substep back, and with it the prediction of the next one
    (`again`), whose velocity it finds. Returns the derivatives by friction and by the share of
    velocity that air damping keeps. `sweep_predict` takes back a prediction alone.

    Branches: above or on the table (its correction acts on z only, friction across), the speed
    clamp, and lanes that are frozen. Sticking is the smooth end of friction, no branch.
    """
    t = structures(scalar, lanes)
    S, V, V3, Adjoint = t.S, t.V, t.V3, t.Adjoint
    stepped = table_contact(scalar, lanes).stepped
    coulomb_gradients = friction_adjoint(scalar, lanes).coulomb_gradients

    @wp.func
    def sweep_finish(
        i: int,
        d: V3,
        z: V,
        radius: S,
        inverse_dt: S,
        mu: V,
        fastest: V,
        on: V,
        all_on: bool,
        again: bool,
        dt: S,
        damping_factor: V,
        fall: V3,
        counts: int,
        adj: Adjoint,
    ):
        zero = V(S(0.0))
        one = V(S(1.0))
        w = adj.w[i]
        g = adj.x[i]
        gv = adj.v[i]
        go = adj.xp[i]
        # the step as it ended
        touches = any_less(z, radius)
        depth = zero
        share = zero
        by_budget = zero
        by_d2 = zero
        e = d
        if touches:
            depth = select(w, wp.max(V(radius) - z, zero), zero)
            share, by_budget, by_d2 = coulomb_gradients(d.x * d.x + d.y * d.y, depth * mu)
            e = V3(d.x - d.x * share, d.y - d.y * share, d.z + depth)
        moved2 = dot(e, e)
        slower = one
        bent = zero
        if any_less(fastest * fastest - moved2, S(0.0)):
            l = wp.max(root(moved2), V(S(1.0e-12)))
            slower = wp.min(one, fastest / l)
            over = less(fastest, l)
            bent = over * slower / (l * l)
            kind = counts + wp.static(int(Kind.SPEED_CLAMP))
            adj.fired[kind] = adj.fired[kind] + over * on
        by_damping = zero
        if wp.static(not with_sheets):
            if again:
                free = select(w, V(dt), zero)
                by_damping = dot(g, e * (slower * inverse_dt) + fall) * free
                gv = gv + g * (damping_factor * free)
                g = g + go
                go = V3(zero, zero, zero)
        # what is frozen ends where it began
        frozen = V3(zero, zero, zero)
        if not all_on:
            frozen = gv * (one - on)
            gv = gv * on
            back = g * (one - on)
            g = g * on
            go = go + back
        adj.v[i] = frozen
        gd = gv * inverse_dt
        gd = gd * slower - e * (bent * dot(gd, e))
        g = g + gd
        go = go - gd
        by_mu = zero
        if touches:
            down = less(zero, depth)
            kind = counts + wp.static(int(Kind.TABLE))
            adj.fired[kind] = adj.fired[kind] + down * on
            kind = counts + wp.static(int(Kind.TABLE_SLIP))
            adj.fired[kind] = adj.fired[kind] + less(share, V(S(0.5))) * down * on
            g_share = zero - d.x * g.x - d.y * g.y
            g_budget = g_share * by_budget
            turn = g_share * by_d2 * S(2.0)
            gx = d.x * turn - g.x * share
            gy = d.y * turn - g.y * share
            gz = down * (g.z + g_budget * mu)
            if adj.parts > 0:
                adj.radius[i] = adj.radius[i] + gz
            by_mu = g_budget * depth
            g = V3(g.x + gx, g.y + gy, g.z - gz)
            go = V3(go.x - gx, go.y - gy, go.z)
        adj.x[i] = g
        adj.xp[i] = go
        return by_mu, by_damping

    @wp.func
    def sweep_predict(i: int, v: V3, dt: S, damping_factor: V, fall: V3, adj: Adjoint):
        g = adj.x[i]
        zero = V(S(0.0))
        free = select(adj.w[i], V(dt), zero)
        adj.v[i] = adj.v[i] + g * (damping_factor * free)
        adj.x[i] = g + adj.xp[i]
        adj.xp[i] = V3(zero, zero, zero)
        return dot(g, v + fall) * free

    return SimpleNamespace(
        sweep_finish=sweep_finish,
        sweep_predict=sweep_predict,
        stepped=stepped,
    )
