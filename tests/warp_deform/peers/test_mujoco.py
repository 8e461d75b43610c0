"""MuJoCo as a peer: the same starts and motions as every other engine, and motion worth timing."""

import sys

import numpy as np
import pytest

from warp_deform.errors import InputError, WarpDeformError
from warp_deform.peers import (
    MujocoSettings,
    MujocoSoftSettings,
    peer_scene,
    soft_scene,
    time_mujoco,
    time_peer,
)
from warp_deform.peers.soft_timing import play_frames

pytest.importorskip("mujoco")

from warp_deform.peers.mujoco_peer import MujocoWorld
from warp_deform.peers.mujoco_soft import MujocoSoftWorld


def _played(scene, settings=None, frames=60):
    world = MujocoWorld(scene, settings)
    for _ in range(frames):
        world.frame()
    return world.beads()


@pytest.mark.parametrize("name", ["cable", "heap", "ring"])
@pytest.mark.parametrize("links", ["tendon", "connect"])
def test_beads_fall_onto_the_table_and_onto_each_other(name, links):
    scene = peer_scene(name, seed=1)
    settings = MujocoSettings(hz=480, iterations=20, links=links)
    assert np.abs(MujocoWorld(scene, settings).beads() - scene.beads).max() < 1e-6
    beads = _played(scene, settings)
    assert scene.stretch(beads) == pytest.approx(1, abs=0.01)
    assert beads[:, 2].min() == pytest.approx(scene.cable.radius, abs=2e-4)
    distance = np.linalg.norm(beads[:, None] - beads, axis=2) + np.eye(len(beads))
    assert distance.min() > 1.9 * scene.cable.radius and beads[:, 2].max() < 0.06


def test_free_fall_is_that_of_the_textbook_and_does_not_depend_on_the_step():
    scene = peer_scene("cable")
    for hz in (240, 960):
        fallen = scene.beads - _played(scene, MujocoSettings(hz=hz), frames=2)
        # semi-implicit Euler falls half a step too far
        expected = 9.8 * (1 / 30) ** 2 / 2 * (1 + 30 / hz)
        assert fallen[:, 2] == pytest.approx(expected, rel=1e-3)


def test_a_world_that_diverges_is_not_started_anew_in_silence(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    wild = MujocoSettings(hz=240, solver="CG", iterations=5, links="connect")
    with pytest.raises(WarpDeformError, match="mujoco diverged on scene cable, start 0"):
        time_mujoco("cable", repeats=1, settings=wild)
    assert list(tmp_path.iterdir()) == []


def test_a_block_lands_flat_where_it_was_and_sleep_keeps_it_there():
    scene = peer_scene("block", seed=1)
    ends = [_played(scene, MujocoSettings(hz=240, sleep=sleep))[0] for sleep in (False, True)]
    assert ends[0][2] == pytest.approx(0.02, abs=2e-4)
    assert np.abs(ends[0][:2] - scene.positions[0, :2]).max() < 2e-3
    assert ends[1] == pytest.approx(ends[0], abs=1e-4)


def test_a_tower_stands_and_its_cubes_stay_over_each_other():
    scene = peer_scene("tower", seed=1)
    assert scene.bodies == 5 and scene.rest_heights == pytest.approx([0.02, 0.06, 0.1, 0.14, 0.18])
    above = scene.positions[:, 2] - scene.rest_heights
    assert above == pytest.approx(0.005 * np.arange(1, 6)), "each falls 5 mm onto the one below"
    assert np.abs(scene.positions[:, :2] - [0.5, 0]).max() < 0.004
    end = _played(scene, MujocoSettings(hz=240))
    assert end[:, 2] == pytest.approx(scene.rest_heights, abs=3e-4)
    assert np.abs(end[:, :2] - scene.positions[:, :2]).max() < 2e-3


@pytest.mark.parametrize("rows", [10, 25])
def test_the_arc_of_a_fold_ends_where_it_mirrors_its_corner(rows):
    for seed in range(5):
        scene = soft_scene(f"fold{rows}", seed=seed)
        assert np.ptp(scene.vertices[:, 2]) == 0 and len(scene.vertices) == rows**2
        way = np.linalg.norm(scene.knots[-1, :2])
        assert 0.12 <= way <= 0.16 and scene.knots[-1, 2] == pytest.approx(0.01)
        assert abs(np.arctan2(*scene.knots[-1, 1::-1]) - np.pi / 4) <= 0.2
        # nearer to the crease than the corner was, so that nothing is drawn over the table
        crease = scene.knots[-1] / 2
        assert np.linalg.norm(scene.knots - crease, axis=1).max() <= 1.02 * way / 2
        assert np.diff(scene.knots[:, :2] @ scene.knots[-1, :2]).min() > 0


def test_a_fold_along_an_arc_does_not_draw_the_sheet():
    scene = soft_scene("fold10", seed=1)
    world = MujocoSoftWorld(scene, MujocoSoftSettings(hz=240, iterations=10))
    lying = scene.vertices
    _, stretch = play_frames(world, scene, round(60 * (scene.before + scene.held)))
    folded = world.vertices()
    assert np.linalg.norm(folded[0, :2] - (lying[0] + scene.knots[-1])[:2]) < 5e-3
    way = scene.knots[-1, :2]
    # well beyond the crease
    still = (lying - lying[0])[:, :2] @ way > 1.2 * way @ way
    assert still.sum() > 30 and stretch < 1.15
    assert np.linalg.norm((folded - lying)[still, :2], axis=1).max() < 2e-3


def test_a_corner_is_carried_to_where_it_was_told_and_stays_folded():
    scene = soft_scene("cloth10")
    world = MujocoSoftWorld(scene)
    assert np.abs(world.vertices() - scene.vertices).max() < 1e-6
    play_frames(world, scene, round(60 * (scene.before + scene.held)))
    carried = world.vertices()[0]
    # it lay at half the first height when it was taken, or lower
    assert np.linalg.norm(carried[:2] - (scene.vertices[0] + scene.knots[-1])[:2]) < 5e-3
    world.release()
    for _ in range(round(60 * scene.after)):
        world.frame()
    end = world.vertices()
    assert np.linalg.norm(end[0, :2] - scene.vertices[0, :2]) > 0.1, "the fold holds"
    assert scene.stretch(end) < 1.1 and -1e-3 < end[:, 2].min() and end[:, 2].max() < 0.06


def test_a_sheet_that_falls_on_a_corner_crumples_within_its_own_size():
    scene = soft_scene("crumple10", seed=2)
    assert scene.vertices[:, 2].min() == pytest.approx(0.02)
    assert scene.lengths == pytest.approx(0.2 / 9)
    assert np.ptp(scene.vertices[:, 2]) > 0.18, "it stands"
    world = MujocoSoftWorld(scene)
    _, stretch = play_frames(world, scene, 60)
    end = world.vertices()
    assert stretch < 1.3 and end[:, 2].max() < 0.12 and end[:, 2].min() > -2e-3


def test_the_bag_s_shell_is_that_of_the_tasks_and_its_beads_weigh():
    scene = soft_scene("shell-cube", seed=1)
    centre = np.array([0.5, 0, 0.15])
    assert np.linalg.norm(scene.vertices - centre, axis=1) == pytest.approx(0.1, abs=1e-9)
    same = soft_scene("bag-cube", seed=1)
    assert scene.vertices[scene.ring] == pytest.approx(same.vertices[same.ring], abs=1e-9)
    world = MujocoSoftWorld(scene)
    total = world._model.body_mass.sum()
    assert total == pytest.approx(scene.mass + 32 * 0.01 + 0.02, rel=1e-6)
    _, stretch = play_frames(world, scene, 15)
    end = world.vertices()
    assert stretch < 1.5 and -2e-3 < end[:, 2].min() and 0.015 < world.cube()[2] < 0.1


def test_senseless_settings_are_refused_and_a_missing_package_names_the_extra(monkeypatch):
    for wrong in ({"hz": 100}, {"hz": 0}, {"iterations": 0}):
        with pytest.raises(InputError, match=f"MujocoSettings.{next(iter(wrong))}"):
            MujocoSoftSettings(**wrong)
    timing = time_peer("mujoco", "block", seconds=0.1, repeats=1)
    assert timing.engine == "mujoco" and timing.hz % 60 == 0 and timing.bodies == 1
    assert 0 < timing.ms_per_sim_second_p50
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(InputError, match=r"pip install -c constraints.txt -e '\.\[dev\]'"):
        time_mujoco("cable")
