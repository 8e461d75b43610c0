"""Contact sheets and statistics of datasets."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from fixtures.episode_samples import make_episode, with_info, with_step
from fixtures.places import ROOT

from warp_deform.collecting.inspection import contact_sheet, statistics
from warp_deform.episodes import EpisodeReader, EpisodeWriter, combine_hashes
from warp_deform.errors import InputError

EXAMPLE = ROOT / "examples" / "read_dataset.py"
SIZE = (320, 160)


@pytest.mark.parametrize("goal", [False, True])
def test_contact_sheet_shows_every_row(tmp_path: Path, goal: bool) -> None:
    episode = make_episode(actions=2, size=SIZE, goal=goal)
    contact_sheet(episode, tmp_path / "a.png")
    contact_sheet(episode, tmp_path / "b.png")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    sheet = cv2.cvtColor(cv2.imread(str(tmp_path / "a.png")), cv2.COLOR_BGR2RGB)
    assert sheet.shape[0] > 3 * SIZE[0]
    assert sheet.shape[1] > (4 if goal else 2) * SIZE[1]
    # The last row has no arrow: its picture stands in the sheet as it is; so does the goal's.
    assert contains(sheet, episode.steps[2].color)
    assert not contains(sheet, episode.steps[0].color)
    if episode.goal is not None:
        assert contains(sheet, episode.goal.color)


def test_arrow_starts_at_the_pick_and_ends_at_the_place(tmp_path: Path) -> None:
    black = np.zeros((*SIZE, 3), np.uint8)
    # Pixels (row 80, column 32) and (row 240, column 128): y = -0.25, 0.25 and x = 0.35, 0.65.
    action = np.array([0.35, -0.25, 0.0, 0.65, 0.25, 0.0, 0.04])
    episode = make_episode(actions=1, size=SIZE)
    drawn = {}
    for name, step_action in (("with", action), ("without", np.full(7, 9.0))):
        changed = with_step(episode, 0, color=black, action=step_action)
        contact_sheet(changed, tmp_path / f"{name}.png")
        drawn[name] = cv2.imread(str(tmp_path / f"{name}.png")).astype(int)
    left = drawn["with"].shape[1] - 2 * (SIZE[1] + 8)
    difference = np.abs(drawn["with"] - drawn["without"]).sum(axis=2)[:, left:]
    rows, columns = np.nonzero(difference[: 70 + SIZE[0]] > 60)
    rows = rows - 70  # the header's height
    assert abs(rows.min() - 80) <= 9 and abs(columns.min() - 32) <= 9
    assert abs(rows.max() - 240) <= 9 and abs(columns.max() - 128) <= 9


def contains(sheet: np.ndarray, picture: np.ndarray) -> bool:
    """Whether the picture stands in the sheet, pixel by pixel."""
    match = cv2.matchTemplate(sheet, picture, cv2.TM_SQDIFF)
    row, column = np.unravel_index(np.argmin(match), match.shape)
    part = sheet[row : row + picture.shape[0], column : column + picture.shape[1]]
    return bool((part == picture).all())


def test_contact_sheet_of_small_flat_and_unusual_episodes(tmp_path: Path) -> None:
    flat = np.zeros((16, 12), np.float32)
    episode = with_step(make_episode(actions=1), 1, height=flat, physics_ok=False)
    episode = with_step(episode, 0, action=np.array([1e30, -1e30, 0.0, 0.5, 0.0, 0.0, 0.1]))
    contact_sheet(with_info(episode, robot="Übung"), tmp_path / "flat.png", scale=3)
    assert cv2.imread(str(tmp_path / "flat.png")) is not None


def test_contact_sheet_refuses_what_it_cannot_draw(tmp_path: Path) -> None:
    episode = make_episode()
    for path in (tmp_path / "sheet.jpg", tmp_path / "missing" / "sheet.png"):
        with pytest.raises(InputError, match="png"):
            contact_sheet(episode, path)
    with pytest.raises(InputError, match="scale 0"):
        contact_sheet(episode, tmp_path / "sheet.png", scale=0)
    with pytest.raises(InputError, match="100 rows, not 102"):
        contact_sheet(make_episode(actions=101), tmp_path / "sheet.png")


def test_statistics_add_up(tmp_path: Path) -> None:
    for seed, actions in ((0, 1), (1, 2), (2, 6)):
        episode = with_info(
            make_episode(seed, actions=actions, goal=seed == 1),
            score=(0.5, 1.0, 0.75)[seed],
            success=seed == 1,
            physics_ok=seed != 2,
        )
        EpisodeWriter(tmp_path).write(episode)
    report = statistics(tmp_path)
    files = list(tmp_path.glob("*.parquet"))
    assert report == {
        "episodes": 3,
        "steps": 9,
        "successes": 1,
        "success_rate": 1 / 3,
        "mean_actions": 3.0,
        "median_actions": 2.0,
        "mean_score": 0.75,
        "physics_ok": 2,
        "discarded_starts": 1,
        "sim_seconds": 13.5,
        "bytes": sum(path.stat().st_size for path in files),
        "tasks": {"cable-ring": 2, "cable-shape-notarget": 1},
        "demonstrators": {"scripted": 3},
        "robots": {"ur5": 3},
        "state_hash": combine_hashes(i.state_hash for i in EpisodeReader(tmp_path).infos()),
    }


def test_statistics_skip_no_damaged_file(tmp_path: Path) -> None:
    EpisodeWriter(tmp_path).write(make_episode(0))
    path = EpisodeWriter(tmp_path).write(make_episode(1))
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(InputError, match=path.name):
        statistics(tmp_path)


def test_example_reads_a_dataset(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for seed in range(2):
        EpisodeWriter(tmp_path).write(make_episode(seed, goal=True))
    sheet = tmp_path / "sheet.png"
    monkeypatch.setattr(sys, "argv", [str(EXAMPLE), str(tmp_path), "--sheet", str(sheet)])
    runpy.run_path(str(EXAMPLE), run_name="__main__")
    assert sheet.exists()
    assert "episodes" in capsys.readouterr().out
