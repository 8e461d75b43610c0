"""What an episode file keeps: everything, bit by bit, but heights to 5 um."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from fixtures.episode_samples import (
    assert_same_episode,
    assert_same_record,
    make_episode,
    with_info,
    with_step,
)
from fixtures.places import ROOT
from hypothesis import given, settings
from hypothesis import strategies as st

import warp_deform
from warp_deform.episodes import (
    HEIGHT_UNIT,
    Episode,
    EpisodeReader,
    EpisodeWriter,
    combine_hashes,
    cpu_fingerprint,
    state_hash,
    versions,
)
from warp_deform.errors import InputError

# Half a unit, and the rounding of float32 at 0.65 m.
HEIGHT_TOLERANCE = 0.5 * HEIGHT_UNIT + 3e-8


def read_back(folder: Path, episode: Episode) -> Episode:
    EpisodeWriter(folder).write(episode)
    return EpisodeReader(folder).read(episode.info.seed)


@pytest.mark.parametrize("goal", [False, True])
@pytest.mark.parametrize("size", [(320, 160), (1, 7)])
def test_round_trip_is_exact(tmp_path: Path, size: tuple[int, int], goal: bool) -> None:
    episode = make_episode(seed=41, size=size, goal=goal)
    actual = read_back(tmp_path, episode)
    assert_same_episode(actual, episode, tolerance=HEIGHT_TOLERANCE)
    reader = EpisodeReader(tmp_path)
    for t, step in enumerate(actual.steps):
        assert_same_record(reader.read_step(41, t), step, tolerance=0.0)
    if goal:
        assert_same_record(reader.read_goal(41), actual.goal, tolerance=0.0)
        assert actual.info.goal is not None and actual.info.goal["kind"] == "constructed"
    else:
        assert reader.read_goal(41) is None and actual.info.goal is None
    # What was read is stored without any further loss, to the same bytes.
    first = reader.path(41).read_bytes()
    assert EpisodeWriter(tmp_path, overwrite=True).write(actual).read_bytes() == first


@settings(derandomize=True, deadline=None, max_examples=40)
@given(seed=st.integers(0, 10**6), actions=st.integers(0, 4), particles=st.integers(0, 9))
def test_round_trip_of_any_episode(
    tmp_path_factory: pytest.TempPathFactory, seed: int, actions: int, particles: int
) -> None:
    episode = make_episode(seed, actions=actions, particles=particles, goal=bool(seed % 2))
    actual = read_back(tmp_path_factory.mktemp("any"), episode)
    assert_same_episode(actual, episode, tolerance=HEIGHT_TOLERANCE)


def test_every_float_survives_bit_by_bit(tmp_path: Path) -> None:
    bits = np.array([0, 2**31, 1, 0x7F800000, 0xFF800000, 0x7FC00001], np.uint32)
    odd = bits.view(np.float32).reshape(2, 3)
    episode = with_step(make_episode(), 1, particle_q=odd, score=-0.0)
    actual = read_back(tmp_path, episode)
    assert actual.steps[1].particle_q.tobytes() == odd.tobytes()
    assert np.signbit(actual.steps[1].score)


@pytest.mark.parametrize("targets", [np.zeros((0, 3)), np.array(-0.1), np.ones((2, 1, 3)) / 3])
def test_goal_targets_of_any_shape(tmp_path: Path, targets: np.ndarray) -> None:
    episode = make_episode(goal=True)
    assert episode.goal is not None
    goal = dataclasses.replace(episode.goal, targets=targets)
    actual = read_back(tmp_path, dataclasses.replace(episode, goal=goal))
    assert actual.goal is not None
    assert actual.goal.targets.shape == targets.shape
    assert actual.goal.targets.tobytes() == targets.tobytes()


def test_numpy_scalars_and_tuples_become_plain_metadata(tmp_path: Path) -> None:
    config = {"lift": np.float32(0.25), "pairs": ((0.1, 2),), "n": np.arange(2)}
    episode = with_info(make_episode(), config=config, success=np.bool_(True))
    info = read_back(tmp_path, episode).info
    assert info.config == {"lift": 0.25, "pairs": [[0.1, 2]], "n": [0, 1]}
    assert info.success is True


def test_any_parquet_reader_opens_a_file(tmp_path: Path) -> None:
    path = EpisodeWriter(tmp_path).write(make_episode(actions=3, goal=True))
    table = pq.read_table(path)
    assert table["step"].to_pylist() == [0, 1, 2, 3]
    assert table["action"].null_count == table["outcome"].null_count == 1
    assert table["goal_color"].null_count == 3
    record = json.loads(table.schema.metadata[b"warp_deform"])
    assert (record["task"], record["format"]) == ("cable-shape-notarget", 1)
    assert table["color"][0].as_py().startswith(b"\x89PNG")


def bad_height(value: float) -> np.ndarray:
    height = np.full((16, 12), 0.1, np.float32)
    height[3, 4] = value
    return height


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"height": bad_height(0.7)}, "heights reach from 0.1 to 0.7 m"),
        ({"height": bad_height(-0.001)}, "heights reach"),
        ({"height": bad_height(np.nan)}, "heights reach"),
        ({"height": bad_height(np.inf)}, "heights reach"),
        ({"height": np.zeros((16, 12))}, "height is float64"),
        ({"color": np.zeros((16, 12, 4), np.uint8)}, "color has shape"),
        ({"color": np.zeros((16, 11, 3), np.uint8)}, "color has shape"),
        ({"particle_q": np.zeros((4, 3))}, "particle_q is float64"),
        ({"body_q": np.zeros((2, 6), np.float32)}, "body_q has shape"),
        ({"ground_truth": [1.0]}, "ground_truth is list"),
        ({"action": None}, "action and outcome"),
        ({"action": np.full(7, np.nan)}, "not finite"),
        ({"outcome": None}, "action and outcome"),
        ({"score": float("nan")}, "score is nan"),
        ({"state_hash": "XYZ"}, "not lower-case hexadecimal"),
    ],
)
def test_writer_refuses_a_bad_step(
    tmp_path: Path, changes: dict[str, object], complaint: str
) -> None:
    with pytest.raises(InputError, match=complaint):
        EpisodeWriter(tmp_path).write(with_step(make_episode(), 1, **changes))
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    "changes",
    [
        {"seed": -1},
        {"seed": 10**9},
        {"seed": 1.0},
        {"actions": 1},
        {"score": float("inf")},
        {"score": 10**400},
        {"task": ""},
        {"config": {"f": print}},
        {"config": {"x": float("nan")}},
        {"versions": None},
        {"success": 1},
        {"goal": {"kind": "constructed"}},
        {"format": 2},
        {"state_hash": "no"},
        {"sim_seconds": "3"},
    ],
)
def test_writer_refuses_bad_metadata(tmp_path: Path, changes: dict[str, object]) -> None:
    with pytest.raises(InputError) as caught:
        EpisodeWriter(tmp_path).write(with_info(make_episode(), **changes))
    assert "\n" not in str(caught.value)
    assert os.listdir(tmp_path) == []


def test_heights_at_the_ends_of_the_range(tmp_path: Path) -> None:
    height = np.linspace(0.0, 0.65535, 16 * 12, dtype=np.float32).reshape(16, 12)
    height[0, 0] = -4e-6  # within half a unit of 0
    actual = read_back(tmp_path, with_step(make_episode(), 0, height=height)).steps[0].height
    assert np.abs(actual.astype(float) - height).max() <= HEIGHT_TOLERANCE
    assert actual.min() == 0.0


@settings(derandomize=True, deadline=None, max_examples=60)
@given(st.lists(st.floats(width=32, allow_nan=False), min_size=1, max_size=6))
def test_state_hash_sees_values_shapes_and_order_only(values: list[float]) -> None:
    array = np.array(values, np.float32)
    known = state_hash(array)
    assert len(known) == 32 and int(known, 16) >= 0
    assert state_hash(np.where(array == 0, -array, array)) == known
    assert state_hash(array.astype(np.float64)) == known
    assert state_hash(np.repeat(array, 2)[::2]) == known
    assert state_hash(array[None]) != known
    assert state_hash(array, array[:0]) != known
    changed = array.copy()
    changed[0] = np.nextafter(array[0], np.float32(0)) if array[0] else 1e-45
    assert state_hash(changed) != known


def test_combine_hashes_depends_on_order_and_grouping() -> None:
    assert combine_hashes(["ab", "cd"]) == combine_hashes(iter(["ab", "cd"]))
    results = [["ab", "cd"], ["cd", "ab"], ["abcd"], ["a", "bcd"], ["abcd", ""], []]
    assert len({combine_hashes(hashes) for hashes in results}) == len(results)
    with pytest.raises(InputError, match="hexadecimal"):
        combine_hashes(["AB"])
    with pytest.raises(InputError, match="dtype"):
        state_hash(np.array(["a"]))


def test_provenance_is_stable_and_imports_no_torch() -> None:
    assert cpu_fingerprint() == cpu_fingerprint() != ""
    assert "\n" not in cpu_fingerprint()
    assert set(versions()) == {"python", "warp-deform", "warp-lang", "newton", "numpy", "torch"}
    assert versions()["numpy"] == np.__version__
    assert versions()["warp-deform"] == warp_deform.__version__
    code = (
        "import sys, warp_deform; before = set(sys.modules)\n"
        "import warp_deform.episodes as e; e.versions(); e.cpu_fingerprint()\n"
        "heavy = {'torch', 'warp', 'newton', 'pyarrow', 'cv2'} & (set(sys.modules) - before)\n"
        "assert not heavy, heavy"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    subprocess.run([sys.executable, "-c", code], check=True, env=environment, timeout=60)
