"""The benchmark's peers: same starts, plausible motion, and costs that are counted, not guessed."""

import importlib.util
import sys
from typing import get_args, get_type_hints

import numpy as np
import pytest

from warp_deform import bench
from warp_deform.command.verbs import BenchOptions
from warp_deform.errors import InputError, WarpDeformError
from warp_deform.peers import (
    NEWTON_SOLVERS,
    PEER_SCENES,
    PEERS,
    NewtonSettings,
    newton_settings,
    peer_scene,
    time_newton,
    time_peer,
    time_pybullet,
)
from warp_deform.peers.newton_peer import NewtonWorld
from warp_deform.peers.pybullet_peer import PyBulletWorld
from warp_deform.peers.timing import measure

needs_pybullet = pytest.mark.skipif(
    importlib.util.find_spec("pybullet") is None, reason="PyBullet has no wheel for this Python"
)


@pytest.mark.parametrize("name, beads, links", [("cable", 24, 23), ("ring", 32, 32)])
def test_starts_are_unstretched_apart_and_above_the_table(name, beads, links):
    scene = peer_scene(name, seed=3)
    assert scene.beads.shape == (beads, 3) and len(scene.links) == links == len(
        set(scene.links[:, 0])
    )
    assert scene.stretch(scene.beads) == pytest.approx(1, abs=2e-3)
    distance = np.linalg.norm(scene.beads[:, None] - scene.beads, axis=2) + np.eye(beads)
    assert distance.min() > 2 * scene.cable.radius
    assert scene.beads[:, 2].min() > scene.cable.radius
    assert scene.stretch(2 * scene.beads) == pytest.approx(2 * scene.stretch(scene.beads))


@pytest.mark.parametrize("name", PEER_SCENES)
def test_a_seed_fixes_the_start_and_another_changes_it(name):
    one, same, other = peer_scene(name, seed=1), peer_scene(name, seed=1), peer_scene(name, seed=2)
    for this, that in ((one.beads, same.beads), (one.positions, same.positions)):
        assert np.array_equal(this, that)
    moving = (one.beads, other.beads) if len(one.beads) else (one.yaws, other.yaws)
    assert np.array_equal(one.yaws, same.yaws) and not np.array_equal(*moving)


class _Clockwork:
    """A world that burns a known CPU time per frame and whose links grow by 1 % a frame."""

    def __init__(self, scene, burn=0.0, break_at=None):
        self.scene, self.burn, self.break_at, self.frames = scene, burn, break_at, 0
        self.positions = scene.beads

    def frame(self):
        import time

        until = time.process_time() + self.burn
        while time.process_time() < until:
            pass
        self.frames += 1
        self.positions = self.scene.beads * (1 + 0.01 * self.frames)

    def beads(self):
        return self.positions * (np.nan if self.frames == self.break_at else 1)

    def close(self):
        self.frames = -1


def _measure(make, **options):
    fixed = {"engine": "clockwork", "scene": "cable", "hz": 60, "iterations": 1, "note": ""}
    return measure(make, **{"seconds": 0.1, "repeats": 2} | fixed | options)


def test_measured_time_is_cpu_time_per_simulated_second():
    timing = _measure(lambda scene: _Clockwork(scene, burn=1e-3), repeats=1)
    assert timing.ms_per_sim_second_p50 == pytest.approx(60, rel=0.2)
    assert timing.rest_ms_per_sim_second_p50 == pytest.approx(60, rel=0.2)
    # 6 frames of fall, then to 2 s, then 6 frames of rest: 126 frames at 1 % each
    assert timing.stretch_max == pytest.approx(2.26, rel=5e-3)
    assert timing.report()["peer_ms_per_sim_second"] == timing.ms_per_sim_second_p50
    assert timing.bodies == 24 and timing.repeats == 1 and timing.seconds == pytest.approx(0.1)


def test_a_peer_that_diverges_is_not_timed():
    with pytest.raises(WarpDeformError, match=r"clockwork diverged on scene cable, start 0"):
        _measure(lambda scene: _Clockwork(scene, break_at=50))


@pytest.mark.parametrize("options", [{"seconds": 0.0}, {"repeats": 0}, {"seconds": float("nan")}])
def test_senseless_measurements_are_refused(options):
    with pytest.raises(InputError):
        _measure(_Clockwork, **options)


def test_unknown_names_are_refused():
    with pytest.raises(InputError, match="cable, heap, ring, block, tower"):
        peer_scene("rope")
    with pytest.raises(InputError, match="vbd, vbd-bodies, xpbd"):
        time_newton("cable", "mujoco")
    with pytest.raises(InputError, match="pybullet, mujoco, newton-vbd"):
        time_peer("flex", "cable")
    with pytest.raises(InputError, match="even"):
        NewtonSettings(solver="xpbd", beads="bodies", substeps=3, iterations=2)
    with pytest.raises(InputError, match="iterations"):
        NewtonSettings(solver="xpbd", beads="bodies", substeps=4, iterations=3)


def test_the_command_offers_every_scene_and_every_peer():
    hints = get_type_hints(BenchOptions)
    assert get_args(hints["scene"]) == bench.SCENES
    offered = next(each for each in get_args(hints["peer"]) if each is not type(None))
    assert set(get_args(offered)) == set(PEERS)


def test_missing_pybullet_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "pybullet", None)
    with pytest.raises(InputError, match=r"pip install -c constraints.txt -e '\.\[dev\]'"):
        time_pybullet("cable")


def _heap(world, frames=72):
    for _ in range(frames):
        world.frame()
    try:
        return world.beads()
    finally:
        world.close()


def _check_settled(scene, beads, *, contact):
    assert 0.9 < scene.stretch(beads) < 1.1
    assert 0.004 < beads[:, 2].min() < 0.006, "the lowest bead rests one radius above the table"
    assert beads[:, 2].max() < 0.06, "the stack has fallen"
    distance = np.linalg.norm(beads[:, None] - beads, axis=2) + np.eye(len(beads))
    assert (distance.min() > 0.008) == contact


@needs_pybullet
@pytest.mark.parametrize("name", ["heap", "ring"])
def test_pybullet_lets_the_scene_fall_into_a_heap(name):
    scene = peer_scene(name)
    _check_settled(scene, _heap(PyBulletWorld(scene)), contact=True)


@pytest.mark.in_a_row("newton-vbd")
@pytest.mark.parametrize("solver", NEWTON_SOLVERS)
def test_newton_lets_the_cable_fall_into_a_heap(solver):
    scene, settings = peer_scene("heap"), newton_settings(solver, "heap")
    beads = _heap(NewtonWorld(scene, settings))
    _check_settled(scene, beads, contact=settings.beads == "bodies")


def test_newton_closes_the_ring():
    scene = peer_scene("ring")
    beads = _heap(NewtonWorld(scene, newton_settings("xpbd", "ring")))
    _check_settled(scene, beads, contact=True)
    assert np.linalg.norm(beads[0] - beads[-1]) == pytest.approx(scene.cable.spacing, rel=0.05)


def test_a_recorded_newton_frame_moves_like_an_eager_one(monkeypatch):
    scene, settings = peer_scene("cable"), newton_settings("xpbd", "cable")
    recorded = NewtonWorld(scene, settings)
    monkeypatch.setattr("warp_deform.peers.newton_peer.record_frame", lambda *_: None)
    eager = NewtonWorld(scene, settings)
    for _ in range(5):
        recorded.frame()
        eager._simulate()
    np.testing.assert_array_equal(recorded.beads(), eager.beads())


@needs_pybullet
def test_cubes_fall_into_a_tower_that_stands_in_pybullet_too():
    scene = peer_scene("tower", seed=2)
    ends = _heap(PyBulletWorld(scene))
    assert ends[:, 2] == pytest.approx(scene.rest_heights, abs=1e-3)
    assert np.abs(ends[:, :2] - scene.positions[:, :2]).max() < 2e-3


@needs_pybullet
@pytest.mark.in_a_row("newton-vbd")
def test_the_block_lands_flat_in_every_engine():
    scene = peer_scene("block", seed=1)
    worlds = [PyBulletWorld(scene)]
    worlds += [NewtonWorld(scene, newton_settings(name, "block")) for name in ("vbd", "xpbd")]
    for world in worlds:
        position = _heap(world)[0]
        assert position[2] == pytest.approx(0.02, abs=1e-3)
        assert np.abs(position[:2] - scene.positions[0, :2]).max() < 0.01


@needs_pybullet
@pytest.mark.in_a_row("newton-vbd")
def test_a_timing_reports_its_settings_and_what_it_leaves_out():
    bullet = time_pybullet("block", seconds=0.1, repeats=1)
    assert (bullet.engine, bullet.hz, bullet.iterations, bullet.bodies) == ("pybullet", 240, 50, 1)
    vbd = time_peer("newton-vbd", "cable", seconds=0.1, repeats=1)
    assert vbd.engine == "newton-vbd" and vbd.hz == 60 * newton_settings("vbd", "cable").substeps
    assert "pass through" in vbd.note and vbd.bodies == 24 and vbd.stretch_max < 1.1
    for timing in (bullet, vbd):
        assert 0 < timing.ms_per_sim_second_p50 <= timing.ms_per_sim_second_p95
        assert timing.rest_ms_per_sim_second_p50 > 0
