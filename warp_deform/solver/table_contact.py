"""Particles on the table (the plane z = 0), and the velocity update that ends a substep."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from .friction import friction, friction_adjoint
from .lanes import add, any_less, div, dot, less, mul, root, select, sub  # noqa: F401
from .structures import structures
from .tape import Kind

__all__ = ["table_contact", "table_contact_adjoint"]


@functools.cache
def table_contact(scalar: Any, lanes: int) -> SimpleNamespace:
    """`predict` begins a substep for a particle, `finish` ends it.

    `finish` pushes the particle out of the table, applies Coulomb friction to its horizontal step,
    and derives the velocity. It returns the squared length of the whole step [m^2] before clamping.
    """
    t = structures(scalar, lanes)
    S, V, V3, Particles = t.S, t.V, t.V3, t.Particles
    coulomb = friction(scalar, lanes).coulomb

    @wp.func
    def predict(i: int, dt: S, kept: V, fall: V3, q: Particles):
        x = q.x[i]
        q.xp[i] = x
        free = select(q.w[i], V(dt), V(S(0.0)))
        q.x[i] = x + (q.v[i] + fall) * (kept * free)

    @wp.func
    def finish(
        i: int, radius: S, inverse_dt: S, mu: V, fastest: V, all_on: bool, on: V, q: Particles
    ):
        x = q.x[i]
        o = q.xp[i]
        zero = V(S(0.0))
        if any_less(x.z, radius):
            depth = select(q.w[i], wp.max(V(radius) - x.z, zero), zero)
            dx = x.x - o.x
            dy = x.y - o.y
            f = coulomb(dx * dx + dy * dy, depth * mu)
            x = V3(x.x - dx * f, x.y - dy * f, x.z + depth)
        d = x - o
        moved2 = dot(d, d)
        v = d * inverse_dt
        # divide only where the clamp may act; fastest [m] is the longest step allowed
        if any_less(fastest * fastest - moved2, S(0.0)):
            v = v * wp.min(V(S(1.0)), fastest / wp.max(root(moved2), V(S(1.0e-12))))
        if not all_on:
            u = q.v[i]
            x = V3(select(on, x.x, o.x), select(on, x.y, o.y), select(on, x.z, o.z))
            v = V3(select(on, v.x, u.x), select(on, v.y, u.y), select(on, v.z, u.z))
            moved2 = moved2 * on
        q.x[i] = x
        q.v[i] = v
        return moved2

    return SimpleNamespace(predict=predict, finish=finish)


@functools.cache
def table_contact_adjoint(scalar: Any, lanes: int) -> SimpleNamespace:
    """`record_finish` ends a substep and leaves a particle's position, that at the start of the
    substep and its old velocity on the tape. `sweep_finish` and `sweep_predict` take that back and
    return the derivatives by friction and by the share of velocity that air damping keeps.

    Branches: above or on the table (its push acts on z only, friction across), the speed clamp, and
    lanes that are frozen. A stick is the smooth end of friction, no branch.
    """
    t = structures(scalar, lanes)
    S, V, V3 = t.S, t.V, t.V3
    Particles, Tape, Adjoint = t.Particles, t.Tape, t.Adjoint
    finish = table_contact(scalar, lanes).finish
    coulomb = friction(scalar, lanes).coulomb
    coulomb_slopes = friction_adjoint(scalar, lanes).coulomb_slopes

    @wp.func
    def record_finish(
        i: int, at: int, radius: S, inverse_dt: S, mu: V, fastest: V, all_on: bool, on: V,
        q: Particles, tape: Tape,
    ):  # fmt: skip
        tape.x[at] = q.x[i]
        tape.x[at + 1] = q.xp[i]
        tape.x[at + 2] = q.v[i]
        return finish(i, radius, inverse_dt, mu, fastest, all_on, on, q)

    @wp.func
    def on_table(x: V3, o: V3, w: V, radius: S, mu: V):
        """Position after the table and friction."""
        zero = V(S(0.0))
        depth = select(w, wp.max(V(radius) - x.z, zero), zero)
        dx = x.x - o.x
        dy = x.y - o.y
        f = coulomb(dx * dx + dy * dy, depth * mu)
        return V3(x.x - dx * f, x.y - dy * f, x.z + depth)

    @wp.func
    def finish_velocity(x: V3, o: V3, w: V, radius: S, inverse_dt: S, mu: V, fastest: V):
        """The velocity that `finish` derives for lanes that are on."""
        y = x
        if any_less(x.z, radius):
            y = on_table(x, o, w, radius, mu)
        d = y - o
        moved2 = dot(d, d)
        v = d * inverse_dt
        if any_less(fastest * fastest - moved2, S(0.0)):
            v = v * wp.min(V(S(1.0)), fastest / wp.max(root(moved2), V(S(1.0e-12))))
        return v

    @wp.func
    def sweep_finish(
        i: int, x: V3, o: V3, radius: S, inverse_dt: S, mu: V, fastest: V, on: V, gv: V3,
        counts: int, adj: Adjoint,
    ):  # fmt: skip
        """`gv`: derivative by the velocity where the lane is on, 0 elsewhere."""
        zero = V(S(0.0))
        one = V(S(1.0))
        w = adj.w[i]
        touches = any_less(x.z, radius)
        y = x
        if touches:
            y = on_table(x, o, w, radius, mu)
        d = y - o
        moved2 = dot(d, d)
        gd = gv * inverse_dt
        if any_less(fastest * fastest - moved2, S(0.0)):
            l = wp.max(root(moved2), V(S(1.0e-12)))
            over = less(fastest, l)
            kind = counts + wp.static(int(Kind.SPEED_CLAMP))
            adj.fired[kind] = adj.fired[kind] + over * on
            slower = wp.min(one, fastest / l)
            gd = gd * slower - d * (over * slower * dot(gd, d) / (l * l))
        g = adj.x[i]
        # what is frozen ends where it began
        back = V3(select(on, zero, g.x), select(on, zero, g.y), select(on, zero, g.z))
        g = g - back + gd
        go = back - gd
        gmu = zero
        if touches:
            depth = select(w, wp.max(V(radius) - x.z, zero), zero)
            dx = x.x - o.x
            dy = x.y - o.y
            d2 = dx * dx + dy * dy
            f = coulomb(d2, depth * mu)
            by_budget, by_d2 = coulomb_slopes(d2, depth * mu, f)
            down = less(zero, depth)
            kind = counts + wp.static(int(Kind.TABLE))
            adj.fired[kind] = adj.fired[kind] + down * on
            kind = counts + wp.static(int(Kind.TABLE_SLIP))
            adj.fired[kind] = adj.fired[kind] + less(f, V(S(0.5))) * down * on
            gf = zero - dx * g.x - dy * g.y
            g_budget = gf * by_budget
            turn = gf * by_d2 * S(2.0)
            gx = dx * turn - g.x * f
            gy = dy * turn - g.y * f
            gz = down * (g.z + g_budget * mu)
            gmu = g_budget * depth
            g = V3(g.x + gx, g.y + gy, g.z - gz)
            go = V3(go.x - gx, go.y - gy, go.z)
        adj.x[i] = g
        adj.xp[i] = adj.xp[i] + go
        return gmu

    @wp.func
    def sweep_predict(i: int, v: V3, dt: S, kept: V, fall: V3, adj: Adjoint):
        g = adj.x[i]
        zero = V(S(0.0))
        free = select(adj.w[i], V(dt), zero)
        adj.v[i] = adj.v[i] + g * (kept * free)
        adj.x[i] = g + adj.xp[i]
        adj.xp[i] = V3(zero, zero, zero)
        return dot(g, v + fall) * free

    return SimpleNamespace(
        record_finish=record_finish, sweep_finish=sweep_finish, sweep_predict=sweep_predict,
        finish_velocity=finish_velocity,
    )  # fmt: skip
