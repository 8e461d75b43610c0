"""The peers' fabrics and bags: the same meshes and motions as ours, and motion worth timing."""

import importlib.util
import time
from functools import partial

import numpy as np
import pytest
from fixtures.cloth_scenes import piercing

from warp_deform import bench
from warp_deform.bench import cloth as bench_cloth
from warp_deform.errors import InputError, WarpDeformError
from warp_deform.peers import (
    SOFT_SCENES,
    NewtonSoftSettings,
    PyBulletSoftSettings,
    soft_scene,
    time_peer,
)
from warp_deform.peers.newton_soft import NewtonSoftWorld
from warp_deform.peers.pybullet_soft import PyBulletSoftWorld
from warp_deform.peers.soft_timing import measure_soft, play_frames

needs_pybullet = pytest.mark.skipif(
    importlib.util.find_spec("pybullet") is None, reason="PyBullet has no wheel for this Python"
)


@pytest.mark.parametrize("rows", [10, 25, 50])
def test_a_sheet_is_the_one_that_our_side_folds(rows):
    scene = soft_scene(f"cloth{rows}", seed=4)
    assert scene.vertices.shape == (rows * rows, 3) and len(scene.triangles) == 2 * (rows - 1) ** 2
    assert scene.lengths == pytest.approx(0.2 / (rows - 1)) and scene.mass == 0.5
    assert scene.margin == pytest.approx(0.2 / (rows - 1) / 5)
    assert np.ptp(scene.vertices, axis=0) == pytest.approx([0.2, 0.2, 0])
    up = np.cross(*np.diff(scene.vertices[scene.triangles], axis=1).transpose(1, 0, 2))
    assert (up[:, 2] > 0).all()
    times = bench_cloth._SETTLE, bench_cloth._FOLD, bench_cloth._LIE
    assert (scene.before, scene.held, scene.after) == times
    assert scene.vertices[0, 2] == bench_cloth._DROP
    way = np.random.default_rng(4).uniform(0.08, 0.16, 2)
    assert scene.knots[-1] == pytest.approx([*way, 0.01])


def test_the_bag_is_the_original_s_open_sphere():
    scene = soft_scene("bag", seed=1)
    assert scene.vertices.shape == (353, 3) and len(scene.triangles) == 320 * 2 + 32
    centre = np.array([0.5, 0, 0.15])
    assert np.linalg.norm(scene.vertices - centre, axis=1) == pytest.approx(0.1)
    ring = scene.vertices[scene.ring]
    radius = np.linalg.norm(ring - ring.mean(axis=0), axis=1)
    assert np.pi * radius**2 == pytest.approx(0.02172, rel=2e-4)
    corners = scene.vertices[scene.triangles]
    outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((corners.mean(axis=1) - centre) * outward).sum(axis=1).min() > 0
    sides = np.sort(scene.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, faces = np.unique(sides, axis=0, return_counts=True)
    assert sorted(set(faces)) == [1, 2] and (faces == 1).sum() == 32, "the opening is the one rim"
    turn = (ring.mean(axis=0) - centre)[2] / 0.0555
    assert 0.5 < turn <= 1.01, "the opening faces up"
    assert not np.array_equal(scene.vertices, soft_scene("bag", seed=2).vertices)


def _after_play(world, scene, seconds=None):
    """Vertices after the play, or its first `seconds`, and the largest stretch."""
    play = scene.before + scene.held + scene.after
    _, stretch = play_frames(world, scene, round(60 * (seconds or play)))
    return world.vertices(), stretch


_SOFT_WORLDS = [
    pytest.param(PyBulletSoftWorld, 0.0037, marks=needs_pybullet, id="pybullet"),
    pytest.param(NewtonSoftWorld, 0.004, marks=pytest.mark.in_a_row("newton-vbd"), id="newton-vbd"),
]


@pytest.mark.parametrize("engine, height", _SOFT_WORLDS)
def test_a_sheet_comes_to_rest_flat_on_the_table(engine, height):
    scene = soft_scene("cloth10")
    world = engine(scene)
    assert np.abs(world.vertices() - scene.vertices).max() < 1e-6
    landed, stretch = _after_play(world, scene, 0.5)
    later, _ = _after_play(world, scene, 0.1)
    world.close()
    assert np.abs(later[:, 2] - height).max() < 5e-4, "one margin, or radius, above the table"
    assert np.abs(later - landed).max() < 5e-4
    assert stretch < 1.05 and np.ptp(later[:, :2], axis=0) == pytest.approx([0.2, 0.2], rel=0.01)


@pytest.mark.parametrize("engine, height", _SOFT_WORLDS)
def test_a_corner_is_carried_to_where_it_was_told_and_stays_folded(engine, height):
    scene = soft_scene("cloth10")
    world = engine(scene)
    carried, _ = _after_play(world, scene, scene.before + scene.held)
    aim = scene.vertices[0] + scene.knots[-1]
    aim[2] = height + scene.knots[-1, 2]
    assert np.linalg.norm(carried[0] - aim) < 2e-3
    world.release()
    for _ in range(round(60 * scene.after)):
        world.frame()
    end = world.vertices()
    world.close()
    assert scene.stretch(end) < 1.25 and np.ptp(end, axis=0)[:2].max() < 0.23
    assert end[:, 2].min() > 0 and end[:, 2].max() < 0.06
    assert np.linalg.norm(end[0, :2] - scene.vertices[0, :2]) > 0.1, "the fold holds"
    if engine is NewtonSoftWorld:
        assert piercing(end, scene.triangles) == 0 and scene.stretch(end) < 1.03


@pytest.mark.in_a_row("newton-vbd")
def test_a_recorded_newton_fold_moves_like_an_eager_one(monkeypatch):
    scene = soft_scene("cloth10")
    settings = NewtonSoftSettings(substeps=2, iterations=3)
    ends = []
    for record in (True, False):
        world = NewtonSoftWorld(scene, settings)
        if not record:
            monkeypatch.setattr("warp.capture_launch", partial(_simulate, world))
        ends.append(_after_play(world, scene, 2.3)[0])
    np.testing.assert_array_equal(*ends)


def _simulate(world, graph):
    world._simulate()


@pytest.mark.in_a_row("newton-vbd")
def test_newton_s_bag_crumples_around_the_cube():
    _check_bag(NewtonSoftWorld, 0.25)


@needs_pybullet
def test_a_tip_of_pybullet_arrives_at_another_rate_too():
    scene = soft_scene("fold10")
    world = PyBulletSoftWorld(scene, PyBulletSoftSettings(hz=240))
    _after_play(world, scene, scene.before + scene.held)
    aim = scene.vertices[0] + scene.knots[-1]
    assert np.linalg.norm((world.vertices()[0] - aim)[:2]) < 2e-3
    world.close()


@needs_pybullet
def test_pybullet_s_bag_crumples_around_the_cube_and_keeps_its_beads():
    world = _check_bag(PyBulletSoftWorld, 0.3)
    beads = world.beads()
    assert np.abs(beads - world.vertices()[soft_scene("bag-cube").ring]).max() < 1e-3
    chain = np.linalg.norm(beads - np.roll(beads, -1, axis=0), axis=1)
    assert chain == pytest.approx(0.0163, rel=0.1)
    world.close()


def _check_bag(engine, seconds):
    scene = soft_scene("bag-cube")
    world = engine(scene)
    end, stretch = _after_play(world, scene, seconds)
    assert stretch < 2 and -1e-3 < end[:, 2].min() < 0.006 and end[:, 2].max() < 0.15
    assert np.abs(end[:, :2] - [0.5, 0]).max() < 0.2, "not blown over the table"
    assert 0.018 < world.cube()[2] < 0.05 and np.abs(world.cube()[:2] - [0.5, 0]).max() < 0.05
    return world


class _SoftClockwork:
    """Burns a CPU millisecond a frame, two while vertex 0 is held, none once it was let go."""

    def __init__(self, scene, break_at=None):
        self.scene, self.break_at, self.frames, self.cost = scene, break_at, 0, 1e-3
        self.targets = []

    def hold(self):
        self.cost = 2e-3

    def release(self):
        self.cost = 0.0

    def frame(self, target=None):
        until = time.process_time() + self.cost
        while time.process_time() < until:
            pass
        self.frames += 1
        self.targets += [] if target is None else [target]

    def vertices(self):
        return self.scene.vertices * (np.nan if self.frames == self.break_at else 1)

    def close(self):
        pass


def _measure_soft(make, **options):
    fixed = {"engine": "clockwork", "scene": "cloth10", "hz": 60, "iterations": 1, "note": "n"}
    return measure_soft(make, **{"seconds": None, "repeats": 1} | fixed | options)


def test_a_sheet_s_time_is_the_mean_over_its_play():
    worlds = []
    timing = _measure_soft(lambda scene: worlds.append(_SoftClockwork(scene)) or worlds[-1])
    assert timing.ms_per_sim_second_p50 == pytest.approx(60 * (0.8 + 2 * 1.3) / 3.3, rel=0.2)
    assert timing.rest_ms_per_sim_second_p50 < 5 and timing.note == "n" and timing.bodies == 100
    targets, scene = np.array(worlds[1].targets), worlds[1].scene
    assert targets.shape == (78, 3) and timing.seconds == pytest.approx(3.3)
    assert targets[-1] == pytest.approx(scene.vertices[0] + scene.knots[-1])
    assert targets[17] == pytest.approx(scene.vertices[0] + scene.knots[1])


def test_a_play_that_was_cut_says_so_and_knows_nothing_of_rest():
    timing = _measure_soft(_SoftClockwork, seconds=0.1)
    assert timing.ms_per_sim_second_p50 == pytest.approx(60, rel=0.2)
    assert timing.note == "n; only the first 0.1 s of the play are timed"
    assert timing.rest_ms_per_sim_second_p50 is None
    assert not [key for key in timing.report() if "rest" in key]
    assert _measure_soft(_SoftClockwork, scene="cloth50").seconds == pytest.approx(0.2)
    assert _measure_soft(_SoftClockwork, seconds=0.1, repeats=9).repeats == 3


def test_a_soft_peer_that_diverges_is_not_timed_and_senseless_lengths_are_refused():
    with pytest.raises(WarpDeformError, match="clockwork diverged on scene cloth10, start 0"):
        _measure_soft(lambda scene: _SoftClockwork(scene, break_at=7))
    for options in ({"seconds": 0.0}, {"seconds": float("nan")}, {"repeats": 0}):
        with pytest.raises(InputError):
            _measure_soft(_SoftClockwork, **options)


@pytest.mark.parametrize("scene", SOFT_SCENES)
def test_peers_without_self_contact_refuse_soft_scenes(scene):
    for peer in ("newton-xpbd", "newton-vbd-bodies"):
        with pytest.raises(InputError, match=f"{peer} does not run the scene '{scene}'"):
            time_peer(peer, scene)
    with pytest.raises(InputError, match="cable, heap, ring, block, tower, cloth10"):
        time_peer("pybullet", scene + "0")
    with pytest.raises(InputError, match="cloth10, cloth25"):
        soft_scene(scene + "0")
    with pytest.raises(InputError, match="even"):
        NewtonSoftSettings(substeps=3)
    for wrong in ({"hz": 100}, {"iterations": 0}):
        with pytest.raises(InputError, match=f"PyBulletSoftSettings.{next(iter(wrong))}"):
            PyBulletSoftSettings(**wrong)


@needs_pybullet
def test_the_bench_times_a_fabric_beside_a_peer():
    report = bench.run(scene="cloth10", peer="pybullet", worlds=1, lanes=1, seconds=0.2, repeats=1)
    assert (report["peer"], report["peer_hz"], report["peer_iterations"]) == ("pybullet", 480, 50)
    assert report["peer_seconds"] == pytest.approx(0.2) and "rest_ratio" not in report
    expected = report["peer_ms_per_sim_second"] / report["ms_per_sim_second"]
    assert report["ratio"] == pytest.approx(expected) and report["ratio"] > 1
    with pytest.raises(InputError, match="newton-xpbd does not run"):
        bench.run(scene="cloth10", peer="newton-xpbd")
