"""Refined trajectories: never worse, replayed to the bit, the same however it was interrupted."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from learning.refinement import film
from learning.refinement.film import check_filmed, film_refined
from learning.refinement.refine import REFINED, REFINEMENT
from learning.refinement.trajectories import (
    TrajectoryConfig,
    TrajectoryReport,
    refine_trajectories,
)
from warp_deform.collecting.collect import CollectConfig, collect
from warp_deform.collecting.control_episodes import control_worlds
from warp_deform.collecting.control_replay import setup_of
from warp_deform.collecting.replay import verify
from warp_deform.command.main import main
from warp_deform.control import optimize
from warp_deform.control.control_worlds import ControlWorlds
from warp_deform.control.smooth_plans import smooth_plan
from warp_deform.control.trajectory_problem import TrajectoryProblem
from warp_deform.episodes import EpisodeReader

BLOCK = "block-notarget"


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.glob("*.parquet")}


def config(source: Path, out: Path, **changes: object) -> TrajectoryConfig:
    return TrajectoryConfig(source=source, out=out, evaluations=24, workers=1, **changes)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("demos")
    collect(CollectConfig(task=BLOCK, episodes=2, seed=6, out=out, workers=1, control=True))
    return out


@pytest.fixture(scope="module")
def refined(demos: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, TrajectoryReport]:
    out = tmp_path_factory.mktemp("refined") / "out"
    before = files(demos)
    report = refine_trajectories(config(demos, out))
    assert files(demos) == before
    return out, report


def test_no_measure_gets_worse_and_steps_and_roughness_get_less(
    refined: tuple[Path, TrajectoryReport],
) -> None:
    out, report = refined
    for info in EpisodeReader(out, control=True).infos():
        story = info.extra[REFINEMENT]
        old, new = story["before"], story["after"]
        assert new["steps"] == info.actions <= old["steps"]
        assert new["roughness"] <= old["roughness"] and new["score"] >= old["score"]
        assert new["solved"] >= old["solved"] and info.success
        assert (info.demonstrator == REFINED) == story["improved"]
    assert report.episodes == 2 and report.improved >= 1 and not report.lost
    assert report.actions_after < report.actions_before
    assert report.roughness_after < report.roughness_before
    assert report.unrested_after <= report.unrested_before


def test_what_is_refined_replays_to_the_bit(refined: tuple[Path, TrajectoryReport]) -> None:
    replayed = verify(refined[0], workers=1)
    assert replayed["episodes"] == 2 and replayed["mismatches"] == 0


def test_an_interrupted_refinement_goes_on_to_the_same_bytes(
    demos: Path, refined: tuple[Path, TrajectoryReport], tmp_path: Path
) -> None:
    whole, out = refined[0], tmp_path / "out"
    out.mkdir()
    for path in whole.iterdir():
        if path.name != "episode_000000007.parquet":
            (out / path.name).write_bytes(path.read_bytes())
    refine_trajectories(config(demos, out))
    assert files(out) == files(whole)


def test_a_block_that_is_let_go_early_beats_nothing(demos: Path) -> None:
    episode = EpisodeReader(demos, control=True).read(6)
    actions = np.array([s.action for s in episode.steps if s.action is not None], np.float32)
    problem = TrajectoryProblem(control_worlds(setup_of(episode.info)), 6, actions)
    assert problem.recorded.rests and problem.recorded.measures is not None
    assert problem.loss(problem.recorded) == 1.0
    early = actions[: len(actions) * 2 // 3].copy()
    early[-5:, -1] = -1.0
    dropped = problem.follow(early)
    assert dropped.measures is not None
    assert dropped.measures.steps < problem.recorded.measures.steps and not dropped.rests
    assert not dropped.beats(problem.recorded) and problem.loss(dropped) > 2.0


def test_a_descent_begins_again_from_plans_of_another_pace(demos: Path) -> None:
    episode = EpisodeReader(demos, control=True).read(6)
    actions = np.array([s.action for s in episode.steps if s.action is not None])
    problem = TrajectoryProblem(control_worlds(setup_of(episode.info)), 6, actions)
    found = optimize(problem, "adam", evaluations=70, population=4)
    assert found.gradients > 10 and found.losses[0] < 1.0  # all stages of the descent
    assert np.isfinite(found.losses).all() and found.numbers[0].shape[0] > problem.shape[0]


def test_the_gradient_of_a_swing_is_that_of_its_losses() -> None:
    control = ControlWorlds("whip-target", 8, lanes=8)
    # gentle, for in a wild one differences mean nothing
    plan = 0.25 * smooth_plan(np.random.default_rng(3), 20) + np.array([0.0, 0.0, 0.2])
    problem = TrajectoryProblem(control, 1, np.pad(plan, ((0, 0), (0, 1)), constant_values=1.0))
    before = problem.recorded.measures
    assert before is not None
    numbers = problem.refined(np.zeros((1, *problem.shape)))
    loss, gradients = problem.gradients(numbers, np.arange(1))
    assert loss[0] == problem.evaluate(numbers[:, None])[0, 0]
    # what is descended is the sum of two of the ratios
    rng, step = np.random.default_rng(0), 0.1
    way = np.zeros_like(numbers)
    way[0, 1:] = rng.normal(size=way[0, 1:].shape)

    def wanted(k: float) -> float:
        measures = problem.walks(numbers + k * step * way)[0].measures
        assert measures is not None
        return float(measures.over(before)[1:].sum())

    there = (wanted(1) - wanted(-1)) / (2 * step)
    assert there == pytest.approx(float((gradients * way).sum()), rel=0.02)


def test_bad_input_ends_in_one_line(
    demos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tries = [
        (["--out", str(demos)], "another folder"),
        (["--out", str(tmp_path / "o"), "--budget", "3"], "--budget does not go with"),
        (["--out", str(tmp_path / "o"), "--method", "gradient"], "does not go with"),
        (["--out", str(tmp_path / "o"), "--horizon", "3"], "picks and places"),
    ]
    for flags, said in tries:
        assert main(["refine", str(demos), "--trajectories", *flags]) == 2
        assert said in capsys.readouterr().err
    assert main(["refine", str(demos), "--out", str(tmp_path / "o"), "--method", "adam"]) == 2
    assert "goes with --trajectories" in capsys.readouterr().err
    assert not (tmp_path / "o").exists()


def test_picks_and_places_are_led_first(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picks, out = tmp_path / "picks", tmp_path / "out"
    collect(CollectConfig(task=BLOCK, episodes=1, seed=6, out=picks, workers=1))
    flags = ["--trajectories", "--evaluations", "8", "--workers", "1", "--json"]
    assert main(["refine", str(picks), "--out", str(out), *flags]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert told["episodes"] == 1 and told["lost"] == 0
    (info,) = EpisodeReader(out, control=True).infos()
    assert info.control is not None and info.extra[REFINEMENT]["demonstrator"] == "scripted"
    assert verify(out, workers=1)["mismatches"] == 0


def test_a_film_shows_what_was_refined_beside_what_it_was(
    demos: Path,
    refined: tuple[Path, TrajectoryReport],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    import imageio.v2 as imageio

    monkeypatch.setattr(film, "FILMED", 1)
    path = tmp_path / "new" / "film.mp4"
    check_filmed(demos, path)
    film_refined(demos, refined[0], path)
    assert imageio.get_reader(path).get_data(0).shape == (540, 1440, 3)


def test_a_film_that_cannot_be_is_refused_before_anything_is_refined(
    demos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picks = tmp_path / "picks"
    collect(CollectConfig(task=BLOCK, episodes=1, seed=6, out=picks, workers=1))
    for source, flags, said in (
        (picks, ["--trajectories", "--video", "f.mp4"], "picks and places"),
        (demos, ["--trajectories", "--video", "f.gif"], "must end with .mp4"),
        (demos, ["--video", "f.mp4"], "--video goes with --trajectories"),
    ):
        out = tmp_path / "out"
        assert main(["refine", str(source), "--out", str(out), *flags]) == 2
        error = capsys.readouterr().err
        assert said in error and error.count("\n") == 1 and not out.exists()
