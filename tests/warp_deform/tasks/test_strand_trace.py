"""The chain found in a mask: gaps, crossings, rings; which end comes first is open."""

from __future__ import annotations

import numpy as np
import pytest

from warp_deform.rendering.strand_mask import MaskLook
from warp_deform.tasks.cable_mask_goal import CableMaskGoal
from warp_deform.tasks.chain_shapes import curved_chain
from warp_deform.tasks.strand_trace import trace_strand

TASK = CableMaskGoal()


@pytest.mark.parametrize("seed", range(6))
def test_a_chain_is_found_in_its_mask(seed: int) -> None:
    """Lone strands; which end comes first is open."""
    rng = np.random.default_rng(seed)
    beads = curved_chain(rng, TASK.cable, TASK.x, TASK.y, bend=4.0)[:, :2]
    assert _error(TASK.mask(beads), beads) < 5e-3


def test_gaps_do_not_tear_a_chain_apart() -> None:
    """Specks in a gap have no direction: linked in turn, the line doubled back to the last of them.

    A tip that a gap cuts off is lost.
    """
    far = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        beads = curved_chain(rng, TASK.cable, TASK.x, TASK.y, bend=1.0)[:, :2]
        look = MaskLook(width=0.9, ragged=0.12, holes=3.0, hole_px=2.5, seed=seed)
        error = _error(TASK.mask(beads, look=look), beads)
        assert error < 0.04, f"seed {seed}: a bead is {1000 * error:.0f} mm off"
        far += error > 0.02
    assert far <= 4


def test_chains_that_cross_themselves_are_followed_to_their_ends() -> None:
    """Linked by the nearest ends first, ten of these go astray: what is left to link is far."""
    astray = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        beads = curved_chain(rng, TASK.cable, TASK.x, TASK.y, bend=7.0, lone=False)[:, :2]
        if _error(TASK.mask(beads), beads) > 0.02:
            astray.append(seed)
    assert len(astray) <= 3, astray


def test_more_pieces_than_are_put_in_order_leave_out_the_shortest() -> None:
    """Ten strokes on a line, and four shorter ones aside, which a link of all would lead over."""
    mask = np.zeros((320, 160), bool)
    lengths = [20, 7, 18, 8, 16, 8, 14, 9, 15, 12, 17, 11, 13, 19]
    start = 10
    for length in lengths:
        column = 80 if length > 9 else 120
        mask[start : start + length, column : column + 3] = True
        start += length + 7
    found = trace_strand(mask, 90)
    assert found is not None
    ends = sorted(found[[0, -1], 0].tolist())
    assert abs(ends[0] - 10) <= 2 and abs(ends[1] - (start - 8)) <= 2
    assert np.abs(found[:, 1] - 81).max() < 2, "none of those aside"


def test_crossing_strands_go_straight_on_and_a_ring_is_opened() -> None:
    t = np.linspace(0.0, 1.0, 90)[:, None]
    # a loop whose ends cross at a right angle
    angle = (0.25 + 1.5 * t) * np.pi + np.pi
    loop = np.array([0.48, 0.0]) + 0.05 * np.hstack([np.cos(angle), np.sin(angle)])
    away = np.linspace(0.002, 0.1, 30)[:, None]
    ends = [
        loop[0] - away[::-1] * _unit(loop[1] - loop[0]),
        loop[-1] + away * _unit(loop[-1] - loop[-2]),
    ]
    line = np.concatenate([ends[0], loop, ends[1]])
    found = _traced(TASK.mask(line), 90)
    gaps = np.linalg.norm(np.diff(found, axis=0), axis=1)
    assert gaps.max() < 1.6 * np.median(gaps), "no jump from strand to strand"
    tips = {tuple(np.round(found[i], 2)) for i in (0, -1)}
    assert tips == {tuple(np.round(line[i], 2)) for i in (0, -1)}
    ring = np.array([0.48, 0.0]) + 0.06 * np.hstack([np.cos(2 * np.pi * t), np.sin(2 * np.pi * t)])
    found = _traced(TASK.mask(ring), 90)
    np.testing.assert_allclose(np.linalg.norm(found - [0.48, 0.0], axis=1), 0.06, atol=3e-3)
    assert trace_strand(np.zeros((320, 160), bool), 90) is None


def _error(mask: np.ndarray, beads: np.ndarray) -> float:
    """How far the worst bead of a chain (n, 2) is from where its mask puts it [m]."""
    found = _traced(mask, len(beads))
    return min(float(np.linalg.norm(found[::way] - beads, axis=1).max()) for way in (1, -1))


def _traced(mask: np.ndarray, points: int) -> np.ndarray:
    """Points x, y [m] along the cable of a mask."""
    found = trace_strand(mask, points)
    assert found is not None
    return TASK.grid.to_world(found)


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v)
