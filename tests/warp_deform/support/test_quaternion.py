"""The quaternions' formulas against SciPy's rotations and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from warp_deform.support.quaternion import (
    quat_by_rotation,
    quat_from_yaw,
    quat_inverse,
    quat_multiply,
    quat_rotate,
    quat_rotate_vjp,
    quat_same_side,
    quat_tangent,
    quat_yaw,
)

COUNT = 200


@pytest.fixture(params=[0, 1])
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    return np.random.default_rng(request.param)


def turns(rng: np.random.Generator) -> Rotation:
    """Random ones, and those at which formulas fail: none, half turns, nearly none."""
    special = [[0, 0, 0], [np.pi, 0, 0], [0, np.pi, 0], [0, 0, np.pi], [1e-9, 0, 0], [0, 0, -3]]
    return Rotation.concatenate([Rotation.random(COUNT, rng=rng), Rotation.from_rotvec(special)])


def same_rotation(quat: np.ndarray, rotation: Rotation) -> bool:
    return float((Rotation.from_quat(quat) * rotation.inv()).magnitude().max()) < 1e-7


def test_rotations_inverses_and_products(rng: np.random.Generator) -> None:
    a, b = turns(rng), turns(rng)[::-1]
    vectors = rng.normal(size=(len(a), 3))
    np.testing.assert_allclose(quat_rotate(a.as_quat(), vectors), a.apply(vectors), atol=1e-14)
    product = quat_multiply(a.as_quat(), b.as_quat())
    np.testing.assert_allclose(np.linalg.norm(product, axis=-1), 1.0, atol=1e-14)
    assert same_rotation(product, a * b) and not same_rotation(product, b * a)
    assert same_rotation(quat_inverse(a.as_quat()), a.inv())


def test_yaws(rng: np.random.Generator) -> None:
    yaw = rng.uniform(-np.pi, np.pi, COUNT)
    assert same_rotation(quat_from_yaw(yaw), Rotation.from_rotvec(np.outer(yaw, [0, 0, 1])))
    np.testing.assert_allclose(quat_yaw(quat_from_yaw(yaw)), yaw, atol=1e-14)
    tilted = Rotation.random(COUNT, rng=rng)
    np.testing.assert_allclose(quat_yaw(tilted.as_quat()), tilted.as_euler("xyz")[:, 2], atol=1e-12)
    assert quat_yaw(-tilted.as_quat()) == pytest.approx(quat_yaw(tilted.as_quat()), abs=1e-14)


def test_one_and_many_have_the_same_bits(rng: np.random.Generator) -> None:
    a, b = Rotation.random(COUNT, rng=rng).as_quat(), Rotation.random(COUNT, rng=rng).as_quat()
    vectors, g = rng.normal(size=(2, COUNT, 3))
    for function, arguments in (
        (quat_rotate, (a, vectors)),
        (quat_multiply, (a, b)),
        (quat_rotate_vjp, (a, vectors, g)),
        (quat_tangent, (a, b)),
        (quat_inverse, (a,)),
        (quat_by_rotation, (a,)),
        (quat_yaw, (a,)),
    ):
        many = function(*arguments)
        one = np.stack([function(*each) for each in zip(*arguments, strict=True)])
        folded = function(*(x.reshape(4, COUNT // 4, -1) for x in arguments))
        assert one.tobytes() == many.tobytes() == folded.tobytes(), function.__name__


def test_derivatives_by_the_four_numbers(rng: np.random.Generator) -> None:
    quat = Rotation.random(COUNT, rng=rng).as_quat()
    vectors, g = rng.normal(size=(2, COUNT, 3))
    step = 1e-6
    for k, by in enumerate(quat_rotate_vjp(quat, vectors, g).T):
        ends = [quat_rotate(quat + sign * step * np.eye(4)[k], vectors) for sign in (1, -1)]
        numeric = ((ends[0] - ends[1]) / (2 * step) * g).sum(axis=-1)
        np.testing.assert_allclose(by, numeric, atol=1e-8)


def test_a_small_turn_and_its_derivative(rng: np.random.Generator) -> None:
    quat = Rotation.random(COUNT, rng=rng)
    turn = 1e-6 * rng.normal(size=(COUNT, 3))
    moved = (Rotation.from_rotvec(turn) * quat).as_quat()
    moved *= np.sign((moved * quat.as_quat()).sum(axis=-1, keepdims=True))
    jacobian = quat_by_rotation(quat.as_quat())
    linear = quat.as_quat() + np.einsum("bk,bkq->bq", turn, jacobian)
    np.testing.assert_allclose(moved, linear, atol=1e-11)
    # what a turn cannot follow is what the tangent leaves out
    g = rng.normal(size=(COUNT, 4))
    tangent = quat_tangent(quat.as_quat(), g)
    np.testing.assert_allclose((tangent * quat.as_quat()).sum(axis=-1), 0.0, atol=1e-14)
    np.testing.assert_allclose(
        np.einsum("bkq,bq->bk", jacobian, g), np.einsum("bkq,bq->bk", jacobian, tangent), atol=1e-14
    )


def test_neighbours_are_on_the_same_side(rng: np.random.Generator) -> None:
    path = Rotation.from_rotvec(np.linspace(0, 1, 30)[:, None] * [0.0, 2.0, 9.0])
    flipped = path.as_quat() * rng.choice([-1.0, 1.0], (30, 1))
    out = quat_same_side(flipped)
    assert ((out[1:] * out[:-1]).sum(axis=-1) > 0).all()
    assert same_rotation(out, path) and (out[0] == flipped[0]).all()
