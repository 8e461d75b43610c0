"""Coulomb friction at position level, smooth at the edge between sticking and sliding."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..lanes.algebra import add, div, less, mul, root, sub  # noqa: F401  (operators are found by name)
from ..lanes.structures import structures

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
    nothing has to hold on a slope. `coulomb_scalar` is `coulomb` for one lane.
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
    """The shares of `friction` and their derivatives by the budget and by moved2:
    `coulomb_gradients`, `coulomb_soft_gradients` and their scalar forms.

    With d the step, b the budget and h = (d^4 + b^4)^(-1/4) the share is f = b h, so df/db =
    h (d h)^4 and df/d(d^2) = -f d^2 h^4 / 2.
    """
    t = structures(scalar, lanes)
    S, V = t.S, t.V
    # the least fourth power of a length that the precision can divide by
    TINY = 1.0e-36 if scalar is wp.float32 else 1.0e-200

    @wp.func
    def coulomb_gradients(moved2: V, budget: V):
        square = budget * budget
        fourth = V(S(1.0)) / wp.max(moved2 * moved2 + square * square, V(S(TINY)))
        h = root(root(fourth))
        share = budget * h
        turn = moved2 * fourth
        return share, h * moved2 * turn, share * turn * S(-0.5)

    @wp.func
    def coulomb_soft_gradients(moved2: V, budget: V):
        inverse = V(S(1.0)) / wp.max(root(moved2 + budget * budget), V(S(1.0e-12)))
        cube = inverse * inverse * inverse
        return budget * inverse, moved2 * cube, budget * cube * S(-0.5)

    @wp.func
    def coulomb_soft_scalar_gradients(moved2: S, budget: S):
        inverse = S(1.0) / wp.max(wp.sqrt(moved2 + budget * budget), S(1.0e-12))
        cube = inverse * inverse * inverse
        return budget * inverse, moved2 * cube, budget * cube * S(-0.5)

    @wp.func
    def coulomb_scalar_gradients(moved2: S, budget: S):
        square = budget * budget
        fourth = S(1.0) / wp.max(moved2 * moved2 + square * square, S(TINY))
        h = wp.sqrt(wp.sqrt(fourth))
        turn = moved2 * fourth
        return budget * h, h * moved2 * turn, budget * h * turn * S(-0.5)

    return SimpleNamespace(
        coulomb_gradients=coulomb_gradients,
        coulomb_soft_gradients=coulomb_soft_gradients,
        coulomb_scalar_gradients=coulomb_scalar_gradients,
        coulomb_soft_scalar_gradients=coulomb_soft_scalar_gradients,
    )
