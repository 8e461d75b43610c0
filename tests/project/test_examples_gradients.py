"""The examples of gradients find what they look for, and do not where the gradients are wrong."""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from fixtures.places import ROOT

from warp_deform.rollout import DifferentiableRollout, Gradients

sys.path.insert(0, str(ROOT / "examples"))

import identify_cable
import straighten_cable


@pytest.fixture(scope="module")
def cord() -> identify_cable.Pull:
    return identify_cable.Pull()


def spoil(monkeypatch: pytest.MonkeyPatch, **factors: float) -> None:
    """Derivatives by these names come out times a factor."""
    right = DifferentiableRollout.backward

    def wrong(self: DifferentiableRollout, *of: Any, **options: Any) -> Gradients:
        out = right(self, *of, **options)
        spoilt = {name: factor * getattr(out, name) for name, factor in factors.items()}
        return replace(out, **spoilt)

    monkeypatch.setattr(DifferentiableRollout, "backward", wrong)


def test_slopes_of_the_recording_are_those_of_differences(cord: identify_cable.Pull) -> None:
    seen = identify_cable.record(cord)[:, :6]
    logs = np.log([0.5, 0.1, 1.0, 2.0])
    _, slopes = cord.loss(logs, seen, 3e-3)
    for i, by in enumerate(slopes):
        step = 1e-6 * np.eye(4)[i]
        above, below = (cord.loss(logs + sign * step, seen, 3e-3)[0] for sign in (1, -1))
        assert by == pytest.approx((above - below) / 2e-6, rel=1e-3, abs=1e-5)


def test_a_recording_tells_friction_damping_and_stiffness(cord: identify_cable.Pull) -> None:
    before = cord.calls
    fitted = identify_cable.fit(cord, identify_cable.record(cord))
    assert (abs(fitted / identify_cable.TRUE - 1) < [0.02, 0.05, 0.05, 0.05]).all()
    assert cord.calls - before < 400


def test_wrong_slopes_do_not_tell(
    cord: identify_cable.Pull, monkeypatch: pytest.MonkeyPatch
) -> None:
    spoil(monkeypatch, table_friction=-1.0)
    fitted = identify_cable.fit(cord, identify_cable.record(cord))
    assert abs(fitted[0] / identify_cable.TRUE[0] - 1) > 0.1


def test_a_pull_straightens_and_needs_the_slopes(monkeypatch: pytest.MonkeyPatch) -> None:
    pull, guess = straighten_cable.Pull(), straighten_cable.DETOUR
    before = straighten_cable.off(pull.simulate(guess))
    monkeypatch.setattr(straighten_cable, "STEPS", 30)
    after = straighten_cable.off(pull.simulate(straighten_cable.descend(pull, guess)))
    assert after < 0.4 * before

    right = DifferentiableRollout.backward

    def reversed_path(self: DifferentiableRollout, *of: Any) -> Gradients:
        out = right(self, *of)
        return replace(out, waypoints={0: -out.waypoints[0]})

    monkeypatch.setattr(DifferentiableRollout, "backward", reversed_path)
    lost = straighten_cable.off(pull.simulate(straighten_cable.descend(pull, guess)))
    assert lost > 2 * after
