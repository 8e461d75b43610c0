"""The comparison with peers: what it measures, what it picks, and that the docs show its rows."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest
from fixtures.cloth_scenes import crumpled, edges_of, piercing
from fixtures.places import ROOT

sys.path.insert(0, str(ROOT / "benchmarks"))

import peers_measures
import peers_report
import peers_rows
import peers_settings

from warp_deform.peers import peer_scene, soft_scene

ONE_RATE = {("pybullet", scene) for scene in ("fold25", "crumple25", "shell-cube")}
"""The original's alone: a play takes the better part of a minute."""


def _row(engine="mujoco", scene="heap", ms=1.0, error=0.5, **errors):
    faults = {"stretch": 1.0, "stretch_end": 1.0, "height_mm": 0.0, "overlap_mm": 0.0, "speed": 0.0}
    settings = {"lanes": 1, "hz": 1200} if engine == "ours" else {"hz": 240, "iterations": 9}
    settings |= {"contact": 2.0, "tolerance": 1e-6, "links": "tendon", "cone": "elliptic"}
    return {
        "kind": "time",
        "engine": engine,
        "scene": scene,
        "settings": settings,
        "ms": ms,
        "errors": {"finite": True, "early_mm": error, **faults, **errors},
    }


def test_the_docs_show_what_was_measured():
    rows = peers_rows.read()
    text = (ROOT / "docs" / "peers.md").read_text()
    for table in (peers_report.table(rows), peers_report.between_table(rows)):
        assert table.count("\n") > 8
        assert table in text


def test_rows_are_of_settings_that_are_searched_and_can_be_made_again():
    for row in peers_rows.read():
        settings = peers_settings.settings_of(row["engine"], row["scene"], row["settings"])
        again = peers_rows.described(row["engine"], row["scene"], settings)
        assert peers_rows.key(again) == peers_rows.key(row)
        assert row["commit"] and row["cpu"] and row["version"]
        assert row["kind"] == "between" or row["ms"] > 0


def test_an_error_is_the_distance_to_the_fine_solution():
    starts = [peer_scene("cable", seed=seed) for seed in range(3)]
    tracks = np.repeat(np.array([start.beads for start in starts])[:, None], 60, axis=1)
    tracks[..., 2] -= tracks[..., 2].min(axis=(1, 2), keepdims=True) - 0.005
    moved = tracks + 1e-3 * np.array([[[[0.0, 0.6, 0.8]]]])
    values = peers_measures.measure_play(starts, moved, tracks)
    assert values["early_mm"] == pytest.approx(1) and values["end_mm"] == pytest.approx(1)
    assert values["height_mm"] == pytest.approx(0.8) and values["stretch_end"] == pytest.approx(1)
    assert values["speed"] == 0 and values["overlap_mm"] == 0
    assert peers_measures.measure_play(starts, moved * np.nan, tracks) == {"finite": False}


def test_a_median_over_starts_does_not_hide_a_fault_of_one():
    starts = [peer_scene("heap", seed=seed) for seed in range(3)]
    tracks = np.repeat(np.array([start.beads for start in starts])[:, None], 60, axis=1)
    broken = tracks.copy()
    broken[2, 30, 5, 0] += 0.01
    values = peers_measures.measure_play(starts, broken, tracks)
    assert values["early_mm"] == 0 and values["stretch"] > 1.1


def test_pierced_edges_are_those_that_the_tests_count():
    scene = soft_scene("cloth10")
    assert peers_measures.pierced(scene.vertices, scene.triangles) == 0
    for seed in range(3):
        x = crumpled(100, seed)
        share = peers_measures.pierced(x, scene.triangles)
        count = len(edges_of(scene.triangles))
        assert share == pytest.approx(piercing(x, scene.triangles) / count) and share > 0


@pytest.mark.parametrize(
    "fault",
    [
        {"stretch_end": 1.03},
        {"stretch": 1.2},
        {"height_mm": 0.3},
        {"overlap_mm": 2.0},
        {"speed": 1},
    ],
)
def test_a_faulty_row_is_not_believable(fault):
    assert peers_measures.believable(_row()) and not peers_measures.believable(_row(**fault))


def test_point_masses_that_never_touch_are_let_overlap_but_not_beads_that_should():
    row = _row(overlap_mm=5.0)
    row["settings"]["beads"] = "particles"
    assert peers_measures.believable(row)
    row["settings"]["beads"] = "bodies"
    assert not peers_measures.believable(row)


def test_the_cheapest_of_equal_error_is_picked_on_both_sides():
    rows = [_row("ours", ms=2.0), _row("ours", ms=1.0, error=30.0)]
    rows[1]["settings"] = {"lanes": 1, "hz": 600}
    rows += [_row(ms=8.0), _row(ms=4.0, stretch=1.5), _row(ms=5.0, error=20.0)]
    rows += [_row("pybullet", ms=9.0, error=30.0), _row("pybullet", ms=10.0, error=20.0)]
    for row in rows[-2:]:
        row["settings"]["world"] = "rigid"
    mujoco, bullet, ours = peers_report.picks(rows)
    assert ours["engine"] == "ours" and ours["ms"] == 2.0 and ours["times_ours"] == 1
    assert mujoco["equal"] and mujoco["times_ours"] == pytest.approx(4)
    assert not bullet["equal"] and bullet["times_ours"] == pytest.approx(5)
    assert "20 (more)" in peers_report.table(rows)


def test_the_original_s_settings_have_a_row_even_where_they_are_not_believable():
    rows = [_row("ours", "cable", ms=2.0), _row("pybullet", "cable", ms=9.0, end_mm=0.1)]
    rows[1]["settings"] = {"hz": 240, "iterations": 10, "world": "rigid"}
    original = _row("pybullet", "cable", ms=90.0, stretch_end=1.3, end_mm=3.0)
    original["settings"] = {"hz": 240, "iterations": 50, "world": "deformable"}
    rows.append(original)
    assert original in peers_report.front(rows, "pybullet")
    found = {row["engine"]: row for row in peers_report.picks(rows)}
    assert found["pybullet"]["ms"] == 9.0 and found["pybullet"]["least_ms"] == 9.0
    row = found["pybullet, as the original"]
    assert row["ms"] == 90.0 and not row["believable"] and row["least_ms"] is None
    # and so has the substep of our tasks
    assert "ours, as shipped" not in found
    rows[0] = _row("ours", "cable", ms=2.0, stretch_end=1.3, end_mm=0.1)
    row = next(row for row in peers_report.picks(rows) if row["engine"] == "ours, as shipped")
    assert row["ms"] == 2.0 and not row["believable"] and row["times_ours"] is None
    assert "3 (not believable)" in peers_report.table(rows)


def test_a_tower_s_heights_are_those_of_cubes_on_each_other():
    starts = [peer_scene("tower", seed=seed) for seed in range(2)]
    ends = np.array([start.positions for start in starts])[:, None].repeat(60, axis=1)
    ends[..., 2] = starts[0].rest_heights
    assert peers_measures.measure_play(starts, ends, None)["height_mm"] == 0
    ends[1, -1, 4, 2] -= 0.04
    values = peers_measures.measure_play(starts, ends, None)
    assert values["height_mm"] == pytest.approx(40)
    row = _row(scene="tower") | {"errors": values}
    assert not peers_measures.believable(row)


def test_fine_solutions_of_two_engines_are_compared_when_errors_are_read():
    rows = [_row("mujoco", "cable", error=9.0, end_mm=1.25), _row("mujoco", "ring", error=2.0)]
    rows += [_row("newton-xpbd", "ring") | {"errors": {"finite": False}}]
    assert peers_report.between_table(rows).count("\n") == 1
    table = peers_report.between_table([row | {"kind": "between"} for row in rows])
    assert table.splitlines()[2:] == ["| cable | 1.2 | - | - | - |", "| ring | 2 | - | none | - |"]


def test_a_front_keeps_what_no_other_beats():
    errors = [8.0, 9.0, 4.0, 3.99, 1.0]
    rows = [replace_ms(_row(error=error), 1.0 + k) for k, error in enumerate(errors)]
    assert [peers_report.error(row) for row in peers_report.front(rows, "mujoco")] == [8, 4, 1]
    many = [replace_ms(_row(error=0.5**k), 1.0 + k) for k in range(30)]
    kept = peers_report.front(many, "mujoco")
    assert len(kept) == peers_report.MOST_TIMED and kept[0] == many[0] and kept[-1] == many[-1]
    # and that which the table asks for
    many = [replace_ms(_row(error=20 * 0.8**k), 1.0 + k) for k in range(30)]
    equal = peers_report.cheapest(many, peers_report.TOLERANCE["heap"])
    kept = peers_report.front(many, "mujoco")
    assert equal in kept and len(kept) == peers_report.MOST_TIMED + 1


def replace_ms(row, ms):
    return row | {"ms": ms}


@pytest.mark.parametrize("scene", peers_settings.SCENES)
def test_every_grid_holds_several_steps_and_no_setting_twice(scene):
    for engine in peers_settings.ENGINES:
        grid = peers_settings.grid(engine, scene)
        assert len(grid) == len(set(grid))
        rates = {getattr(s, "hz", getattr(s, "substeps", None)) for s in grid}
        assert not grid or len(rates) >= 2 or (engine, scene) in ONE_RATE
        assert all(s == replace(s) for s in grid)
        assert peers_settings.fine(engine, scene) not in grid


def test_rows_are_kept_once_and_the_last_counts(tmp_path):
    path = tmp_path / "rows.jsonl"
    for ms in (1.0, 2.0):
        peers_rows.append(_row(ms=ms), path)
    peers_rows.append(_row(ms=3.0) | {"kind": "search"}, path)
    assert [row["ms"] for row in peers_rows.read(path)] == [2.0, 3.0]
    assert peers_rows.read(tmp_path / "none.jsonl") == []
