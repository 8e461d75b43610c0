"""Replay and film: what was recorded happens again, and what was tampered with is found out."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fixtures.episode_samples import make_episode

from warp_deform.collecting import video as filming
from warp_deform.collecting.collect import CollectConfig, collect
from warp_deform.collecting.replay import verify
from warp_deform.collecting.video import film
from warp_deform.episodes import Episode, EpisodeReader, EpisodeWriter
from warp_deform.errors import InputError, WarpDeformError

TASK = "cable-line-notarget"
SEED = 300


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("demos")
    collect(CollectConfig(task=TASK, episodes=3, seed=SEED, out=out, workers=1))
    return out


def altered(demos: Path, out: Path, change: Callable[[Episode], Episode]) -> Path:
    """A copy of the folder whose first episode is changed."""
    shutil.copytree(demos, out)
    first = EpisodeReader(out).seeds[0]
    EpisodeWriter(out, overwrite=True).write(change(EpisodeReader(out).read(first)))
    return out


def with_row(episode: Episode, t: int, **changes: object) -> Episode:
    steps = list(episode.steps)
    steps[t] = replace(steps[t], **changes)  # type: ignore[arg-type]
    return replace(episode, steps=tuple(steps))


def nudge(episode: Episode, metres: float) -> Episode:
    """The episode with the first place point moved along x."""
    action = episode.steps[0].action
    assert action is not None
    return with_row(episode, 0, action=action + np.array([0, 0, 0, metres, 0, 0, 0]))


def test_a_recording_happens_again(demos: Path) -> None:
    rows = sum(info.actions + 1 for info in EpisodeReader(demos).infos())
    assert verify(demos, workers=1) == {
        "episodes": 3,
        "steps": rows,
        "mismatches": 0,
        "max_error": 0.0,
        "cpu": "same",
        "versions": "same",
    }


def test_a_changed_action_is_found(demos: Path, tmp_path: Path) -> None:
    folder = altered(demos, tmp_path / "demos", lambda episode: nudge(episode, 0.01))
    actions = EpisodeReader(folder).infos()[0].actions
    report = verify(folder, workers=1)
    assert report["mismatches"] == actions, "every row but the start"
    assert report["max_error"] > 0.001


def test_tolerance_forgives_small_differences_only(demos: Path, tmp_path: Path) -> None:
    def shift(episode: Episode) -> Episode:
        q = episode.steps[-1].particle_q + np.float32(1e-4)
        return with_row(episode, -1, particle_q=q, state_hash="00")

    folder = altered(demos, tmp_path / "demos", shift)
    assert verify(folder, workers=1)["mismatches"] == 1
    assert verify(folder, tolerance=1e-3, workers=1)["mismatches"] == 0
    report = verify(folder, tolerance=1e-5, workers=1)
    assert report["mismatches"] == 1
    assert report["max_error"] == pytest.approx(np.sqrt(3) * 1e-4, rel=0.01)


def test_a_changed_score_or_success_is_found(demos: Path, tmp_path: Path) -> None:
    folder = altered(demos, tmp_path / "a", lambda e: with_row(e, 0, score=0.5))
    assert verify(folder, workers=1)["mismatches"] == 1
    folder = altered(demos, tmp_path / "b", lambda e: with_row(e, 0, success=True))
    assert verify(folder, workers=1)["mismatches"] == 1


def test_another_processor_is_named(demos: Path, tmp_path: Path) -> None:
    folder = altered(
        demos, tmp_path / "demos", lambda e: replace(e, info=replace(e.info, cpu="abacus"))
    )
    report = verify(folder, workers=1)
    assert (report["cpu"], report["versions"], report["mismatches"]) == ("other", "same", 0)


def test_what_cannot_be_replayed_is_refused(demos: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no episodes"):
        verify(tmp_path)
    with pytest.raises(InputError, match="tolerance is -1"):
        verify(demos, tolerance=-1)
    real = altered(demos, tmp_path / "real", lambda e: with_row(e, 0, state_hash=""))
    with pytest.raises(InputError, match="was not simulated"):
        verify(real, workers=1)
    EpisodeWriter(tmp_path / "other").write(make_episode(0))
    with pytest.raises(InputError, match="replay it with the version"):
        verify(tmp_path / "other", workers=1)


def test_film(demos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import imageio.v2 as imageio

    monkeypatch.setattr(filming, "LONGEST", 3.0)
    film(demos, tmp_path / "film.mp4", size=(90, 160))
    frames = np.stack([np.asarray(f) for f in imageio.get_reader(tmp_path / "film.mp4")])
    assert frames.shape[1:] == (90, 160, 3)
    assert 2.5 < len(frames) / filming.FPS < 4.0
    moved = np.abs(np.diff(frames.astype(int), axis=0)).max(axis=(1, 2, 3))
    still = round(filming.STILL_SECONDS * filming.FPS) - 1
    assert (moved[2 : still - 1] < 40).all(), "it begins with a still picture"
    assert np.median(moved[still + 1 : -still]) > 60, "then the arm moves"


def test_a_video_shows_the_recording_or_nothing(demos: Path, tmp_path: Path) -> None:
    folder = altered(demos, tmp_path / "demos", lambda episode: nudge(episode, 0.01))
    with pytest.raises(WarpDeformError, match="row 1 of seed 300 comes out differently"):
        film(folder, tmp_path / "film.mp4", size=(90, 160))
    with pytest.raises(InputError, match="must end with"):
        film(demos, tmp_path / "film.gif")
    with pytest.raises(InputError, match="no episode"):
        film(demos, tmp_path / "film.mp4", seeds=[])
    assert not list(tmp_path.glob("*film*"))
