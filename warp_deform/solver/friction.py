"""Coulomb friction at position level, smooth at the edge between sticking and sliding."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from .lanes import add, div, less, mul, root, sub  # noqa: F401  (operators are found by name)
from .structures import structures

__all__ = ["friction", "friction_adjoint"]


@functools.cache
def friction(scalar: Any, lanes: int) -> SimpleNamespace:
    """`coulomb(moved2, budget)`: the share of a tangential step [m^2] that friction takes back.

    With d the length of the tangential relative step and b the budget (friction coefficient times
    normal correction), the share is ``b / (d^4 + b^4)^(1/4)``: all of it while d is well below b
    (stick), exactly the Coulomb amount ``b / d`` once d is well above (slide), and differentiable
    in between. The sharper power 4 is used because with power 2 a body at 90 % of the friction
    angle would creep at 5 mm/s; with power 4 it creeps at 1 mm/s there, at 80 % at 0.5 mm/s.

    `coulomb_soft` is the form with power 2, a third cheaper, for contacts between particles, where
    nothing has to hold on a slope.
    """
    t = structures(scalar, lanes)
    S, V = t.S, t.V

    @wp.func
    def coulomb(moved2: V, budget: V):
        one = V(S(1.0))
        # bounded so that the square below stays finite in float32
        ratio = wp.min(budget * budget / wp.max(moved2, V(S(1.0e-30))), V(S(1.0e8)))
        return root(ratio / root(one + ratio * ratio))

    @wp.func
    def coulomb_soft(moved2: V, budget: V):
        return budget / wp.max(root(moved2 + budget * budget), V(S(1.0e-12)))

    @wp.func
    def coulomb_scalar(moved2: S, budget: S):
        ratio = wp.min(budget * budget / wp.max(moved2, S(1.0e-30)), S(1.0e8))
        return wp.sqrt(ratio / wp.sqrt(S(1.0) + ratio * ratio))

    return SimpleNamespace(
        coulomb=coulomb, coulomb_soft=coulomb_soft, coulomb_scalar=coulomb_scalar
    )


@functools.cache
def friction_adjoint(scalar: Any, lanes: int) -> SimpleNamespace:
    """Slopes of `coulomb` and `coulomb_soft` by their budget and by `moved2`, as a pair.

    With the ratio r = b^2 / d^2 the share is f = sqrt(r / sqrt(1 + r^2)), so df/db =
    f / (b (1 + r^2)) and df/d(d^2) = -f / (2 d^2 (1 + r^2)); where r is bounded, both are 0.
    """
    t = structures(scalar, lanes)
    S, V = t.S, t.V

    @wp.func
    def coulomb_slopes(moved2: V, budget: V, share: V):
        tiny = V(S(1.0e-30))
        bound = V(S(1.0e8))
        below = wp.max(moved2, tiny)
        ratio = wp.min(budget * budget / below, bound)
        one = V(S(1.0))
        slope = less(ratio, bound) * share / (one + ratio * ratio)
        return slope / wp.max(budget, tiny), slope / below * S(-0.5)

    @wp.func
    def coulomb_soft_slopes(moved2: V, budget: V):
        inverse = V(S(1.0)) / wp.max(root(moved2 + budget * budget), V(S(1.0e-12)))
        cube = inverse * inverse * inverse
        return moved2 * cube, budget * cube * S(-0.5)

    @wp.func
    def coulomb_soft_scalar_slopes(moved2: S, budget: S):
        inverse = S(1.0) / wp.max(wp.sqrt(moved2 + budget * budget), S(1.0e-12))
        cube = inverse * inverse * inverse
        return moved2 * cube, budget * cube * S(-0.5)

    @wp.func
    def coulomb_scalar_slopes(moved2: S, budget: S, share: S):
        below = wp.max(moved2, S(1.0e-30))
        ratio = budget * budget / below
        slope = S(0.0)
        if ratio < S(1.0e8):
            slope = share / (S(1.0) + ratio * ratio)
        return slope / wp.max(budget, S(1.0e-30)), slope / below * S(-0.5)

    return SimpleNamespace(
        coulomb_slopes=coulomb_slopes, coulomb_soft_slopes=coulomb_soft_slopes,
        coulomb_scalar_slopes=coulomb_scalar_slopes,
        coulomb_soft_scalar_slopes=coulomb_soft_scalar_slopes,
    )  # fmt: skip
