"""The script that measures how far a teacher's labels lie from what a policy does."""

from __future__ import annotations

import sys

import pytest
from fixtures.places import ROOT

from warp_deform.tasks.cable_ring import CableRing, CableRingNotarget

sys.path.insert(0, str(ROOT / "benchmarks"))

import teacher_labels

POLICY = ROOT / "benchmarks/results/learning/policies/cable-ring-notarget-distilled"


def test_a_teacher_that_goes_by_what_is_hidden_asks_for_far_places(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen = teacher_labels.measured("cable-ring-notarget", POLICY, "mpc", 1)
    monkeypatch.setattr(CableRingNotarget, "aims", CableRing.aims)
    hidden = teacher_labels.measured("cable-ring-notarget", POLICY, "mpc", 1)
    assert seen["states"] == hidden["states"] > 1
    assert hidden["place_mm"] > 2 * seen["place_mm"] > 0
