"""Coulomb friction at position level, smooth at the edge between sticking and sliding."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from .lanes import add, div, mul, root, sub  # noqa: F401  (operators are found by name)
from .structures import structures

__all__ = ["friction"]


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
