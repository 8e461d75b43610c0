"""The jaw's geometry, and what it does to a chain: grip, miss, push, press, drag, slip."""

from __future__ import annotations

from functools import cache

import newton
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from warp_deform.errors import InputError
from warp_deform.objects.cable import Cable, add_cable
from warp_deform.robots.jaw import Jaw, JawConfig, JawContact, between, squeezed_width
from warp_deform.robots.jaw_primitive import JawActionConfig, hand_pose, jaw_motion
from warp_deform.solver import SolverFusedXPBD
from warp_deform.tasks.chain_physics import BEAD_CHAIN, CHAIN_SOLVER
from warp_deform.tasks.chain_shapes import curved_chain, straight_chain, tossed_chain

R = BEAD_CHAIN.radius
MIDDLE = np.array([0.5, 0.0])
STEPS = 4
TICK = STEPS * CHAIN_SOLVER.dt
GRASP = 0.010


@cache
def chain_world() -> tuple[SolverFusedXPBD, Cable]:
    builder = newton.ModelBuilder()
    SolverFusedXPBD.register_custom_attributes(builder)
    chain = add_cable(builder, BEAD_CHAIN, straight_chain(BEAD_CHAIN, MIDDLE, 0.0))
    solver = SolverFusedXPBD(builder.finalize(device="cpu"), CHAIN_SOLVER, lanes=1)
    solver.set_duration(1e7, 1e7)
    return solver, chain


class Scene:
    """A chain and a jaw whose hand moves at 0.1 m/s, its fingers at 0.05 m/s."""

    def __init__(self, points: np.ndarray | None = None, *, slip: float = 0.0) -> None:
        self.solver, chain = chain_world()
        self.solver.data.reset()
        if points is not None:
            self.solver.data.lane("particles.x", 0)[:] = points
        rng = np.random.default_rng(0)
        self.jaw = Jaw(self.solver, 0, chain, JawConfig(slip=slip), rng=rng)
        self.tip = np.array([*MIDDLE, 0.03, 0.0])
        self.opening = 0.035
        self.closing = False
        self.felt: list[JawContact] = []

    @property
    def beads(self) -> np.ndarray:
        return self.solver.particle_q(0).astype(float)

    def tick(self) -> JawContact:
        pose = hand_pose(self.tip)
        felt = self.jaw.move(pose, self.opening, closing=self.closing, steps=STEPS)
        values = self.solver.run(STEPS)
        assert values[0].problems(0, CHAIN_SOLVER.limits) == ()
        self.felt.append(felt)
        return felt

    def go(self, *tip: float, speed: float = 0.1) -> None:
        start, end = self.tip, np.array(tip)
        seconds = max(np.linalg.norm((end - start)[:3]) / speed, abs(end[3] - start[3]) / 0.5)
        count = max(1, int(np.ceil(seconds / TICK)))
        for k in range(1, count + 1):
            self.tip = start + (end - start) * k / count
            self.tick()

    def grasp(self) -> bool:
        self.closing = True
        while self.opening > 0 and not len(self.jaw.held):
            self.opening = max(self.opening - 0.05 * TICK, self.felt[-1].width, 0.0)
            self.tick()
        return len(self.jaw.held) > 0

    def release(self) -> None:
        self.closing = False
        while self.opening < 0.03:
            self.opening += 0.05 * TICK
            self.tick()

    def wait(self, seconds: float) -> None:
        for _ in range(round(seconds / TICK)):
            self.tick()


def down(yaw: float, *, off: float = 0.0, **options: float) -> Scene:
    """A hand over the middle bead, turned by `yaw` from the chain and `off` [m] beside it."""
    scene = Scene(**options)
    scene.tip = np.array([0.5, off, 0.03, yaw])
    scene.go(0.5, off, GRASP, yaw, speed=0.05)
    return scene


# Geometry.


def test_between_takes_what_the_pads_enclose() -> None:
    config = JawConfig()
    low = config.tip - 2 * R  # a bead on the foam under fingers just above it
    local = np.array(
        [[0, 0, low], [0.007, 0.004, low], [0.010, 0, low], [0, 0.018, low], [0, 0, config.tip],
         [0, 0, -0.05]]
    )  # fmt: skip
    assert between(local, 0.035, radius=R, config=config).tolist() == [0, 1]
    assert between(local, 0.006, radius=R, config=config).tolist() == [0]


def test_strands_side_by_side_add_up_and_strands_on_top_do_not() -> None:
    strand = np.column_stack([np.linspace(-0.005, 0.005, 3), np.zeros(3), np.zeros(3)])
    numbers = np.array([4, 5, 6, 40, 41, 42])
    local = np.zeros((50, 3))
    local[4:7] = strand
    local[40:43] = np.add(strand, (0, 2 * R, 0))
    assert squeezed_width(local, numbers, radius=R) == pytest.approx(4 * R)
    local[40:43] = np.add(strand, (0, 0, -2 * R))
    assert squeezed_width(local, numbers, radius=R) == pytest.approx(2 * R)
    assert squeezed_width(local, numbers[:3], radius=R) == pytest.approx(2 * R)
    assert squeezed_width(local, numbers[:0], radius=R) == 0.0


def test_wrong_fingers_are_refused() -> None:
    for wrong in ({"slip": 1.5}, {"pad_length": 0.0}, {"stiffness": -1.0}, {"tip": np.nan}):
        with pytest.raises(InputError, match="JawConfig"):
            JawConfig(**wrong)
    with pytest.raises(InputError, match="generator"):
        Jaw(*[chain_world()[0], 0, chain_world()[1]], JawConfig(slip=0.5))
    with pytest.raises(InputError, match="lift"):
        JawActionConfig(short_lift_m=np.inf)


# On a chain.


def test_a_grip_across_the_chain_holds_a_few_beads_as_wide_as_the_chain() -> None:
    scene = down(0.0)
    assert max(felt.force for felt in scene.felt) == 0.0
    assert scene.grasp()
    assert scene.opening == pytest.approx(2 * R, abs=1e-4)
    assert 3 <= len(scene.jaw.held) <= 4 and (np.diff(scene.jaw.held) == 1).all()
    assert set(scene.jaw.held) <= set(range(40, 50))


def test_a_chain_off_the_middle_is_pushed_to_the_middle() -> None:
    scene = down(0.0, off=0.010)
    assert scene.grasp()
    held = scene.beads[scene.jaw.held]
    assert np.abs(held[:, 1] - 0.010).max() < 0.5e-3


def test_fingers_beside_the_chain_take_nothing_and_move_nothing() -> None:
    scene = down(0.0, off=0.035)
    assert not scene.grasp() and scene.opening == 0.0
    assert np.abs(scene.beads[:, 1]).max() < 1e-4


def test_a_finger_that_comes_down_on_the_chain_presses_it_and_misses() -> None:
    """Along the chain's middle; where its edge meets the chain's side, it pushes instead."""
    onto = down(0.0, off=0.0175 + 0.004)
    assert onto.felt[-1].force > 8.0  # N
    assert np.abs(onto.beads[:, 1]).max() < 0.5e-3
    onto.go(0.5, 0.0215, 0.0, 0.0)  # back off upwards as far as the force says
    beside = down(0.0, off=0.0175 + 0.008 + 0.0015)
    assert beside.felt[-1].force == 0.0
    assert beside.beads[44:46, 1].min() < -0.5e-3


def test_fingers_along_the_chain_press_it_or_hold_it_lengthwise() -> None:
    """With the hand a quarter turn off, the opening lies along the chain."""
    scene = down(np.pi / 2)
    assert scene.felt[-1].force > 8.0
    assert not scene.grasp() or scene.opening > 1.5 * R


def test_held_beads_follow_the_hand_and_the_rest_drags_behind() -> None:
    scene = down(0.0)
    assert scene.grasp()
    held = scene.jaw.held.copy()
    offsets = scene.beads[held] - scene.tip[:3]
    scene.go(0.5, 0.0, 0.05, 0.0)
    assert np.abs(scene.beads[held] - scene.tip[:3] - offsets).max() < 0.3e-3
    scene.go(0.5, 0.2, 0.05, 0.6)
    c, s = np.cos(0.6), np.sin(0.6)
    turned = offsets @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    assert np.abs(scene.beads[held] - scene.tip[:3] - turned).max() < 0.3e-3
    beads = scene.beads
    lengths = np.linalg.norm(np.diff(beads, axis=0), axis=1) / BEAD_CHAIN.spacing
    assert 0.98 < lengths.mean() < 1.03 and lengths.max() < 1.2
    assert (beads[[0, -1], 1] < 0.15).all(), "friction holds the ends back"
    assert (beads[:, 2] > R - 1e-4).all() and beads[[0, -1], 2].max() < 2 * R
    scene.go(0.5, 0.2, 0.015, 0.6, speed=0.05)
    scene.release()
    scene.go(0.5, 0.2, 0.07, 0.6)
    scene.wait(0.5)
    after = scene.beads
    assert np.linalg.norm(after[held].mean(axis=0)[:2] - [0.5, 0.2]) < 8e-3
    scene.wait(0.5)
    assert np.abs(scene.beads - after).max() < 1e-4, "it lies still"
    assert after[:, 2].max() < 6 * R


def test_two_strands_side_by_side_are_taken_together() -> None:
    points = straight_chain(BEAD_CHAIN, MIDDLE, 0.0)
    points[45:] = points[44::-1] + np.array([0.0, 3 * R, 0.0])  # a hairpin
    scene = Scene(points)
    x = points[20, 0]
    scene.tip = np.array([x, 1.5 * R, 0.03, 0.0])
    scene.go(x, 1.5 * R, GRASP, 0.0, speed=0.05)
    assert scene.grasp()
    assert scene.opening == pytest.approx(4 * R, abs=2e-4)
    assert (scene.jaw.held < 45).any() and (scene.jaw.held >= 45).any()


def test_a_slipping_grip_is_lost_on_the_way_and_not_taken_up_again() -> None:
    scene = down(0.0, slip=1.0)
    assert scene.grasp()
    scene.go(0.5, 0.0, 0.05, 0.0)
    scene.wait(1.6)
    assert scene.jaw.lost and len(scene.jaw.held) == 0
    assert scene.beads[:, 2].max() < 0.04


def test_a_hand_far_above_does_nothing() -> None:
    scene = Scene()
    scene.tip[2] = 0.3
    assert not scene.jaw.near(hand_pose(scene.tip))
    before = scene.beads
    assert scene.tick() == JawContact(0.0, 0.0)
    assert np.abs(scene.beads - before).max() < 1e-6


# Shapes and motions.


@settings(derandomize=True, deadline=None, max_examples=25)
@given(seed=st.integers(0, 10_000), bend=st.floats(0.0, 3.0))
def test_curves_have_the_chains_length_and_stay_inside(seed: int, bend: float) -> None:
    x, y = (0.335, 0.635), (-0.3, 0.3)
    beads = curved_chain(np.random.default_rng(seed), BEAD_CHAIN, x, y, bend=bend)
    lengths = np.linalg.norm(np.diff(beads, axis=0), axis=1)
    assert np.abs(lengths - BEAD_CHAIN.spacing).max() < 1e-9
    assert beads[:, 0].min() > x[0] and beads[:, 0].max() < x[1]
    assert beads[:, 1].min() > y[0] and beads[:, 1].max() < y[1]
    tossed = tossed_chain(np.random.default_rng(seed), BEAD_CHAIN, x, y)
    gaps = np.linalg.norm(tossed[:, None] - tossed[None], axis=-1)
    apart = np.abs(np.subtract.outer(np.arange(90), np.arange(90))) > 20
    assert gaps[apart].min() > R, "strands that cross do so at different heights"


def test_the_planned_motion_is_continuous_and_keeps_its_speeds() -> None:
    config = JawActionConfig()
    action = np.array([0.45, -0.1, 1.2, 0.5, 0.2, -1.4, 0.05])
    motion = jaw_motion(np.array([0.5, 0.0, 0.3, 0.0]), action, config)
    steps, seconds = np.diff(motion.waypoints, axis=0), np.diff(motion.times)
    assert (np.linalg.norm(steps[:, :3], axis=1) <= config.speed * seconds + 1e-9).all()
    assert (np.abs(steps[:, 3]) <= config.turn_speed * seconds + 1e-9).all()
    assert motion.waypoints[:, 2].min() == pytest.approx(config.grasp_m)
    assert np.ptp(motion.waypoints[3:, 3]) == pytest.approx(2.6, abs=0.1)
