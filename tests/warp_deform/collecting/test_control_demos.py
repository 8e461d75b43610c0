"""Demonstrations at 20 Hz: their actions, replayed in the environment, give the recorded bits."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import warp_deform  # noqa: F401  (registers the ids)
from warp_deform.collecting.collect import CollectConfig, collect
from warp_deform.collecting.control_demos import ControlChunk, attempt_control_chunk
from warp_deform.collecting.control_episodes import ControlEpisode, without_idle_end
from warp_deform.collecting.control_video import film_control
from warp_deform.collecting.replay import verify
from warp_deform.collecting.video import FPS, STILL_SECONDS
from warp_deform.command.main import main
from warp_deform.control.control_worlds import ControlWorlds
from warp_deform.control.swing_problem import SwingProblem
from warp_deform.control.tip_demonstrator import TipDemonstrator
from warp_deform.episodes import (
    CONTROL,
    CONTROL_FORMAT,
    Episode,
    EpisodeReader,
    EpisodeWriter,
    Step,
)
from warp_deform.errors import InputError, WarpDeformError

BLOCK, SEEDS = "block-notarget", (6, 7)


def config(out: Path, **changes: object) -> CollectConfig:
    plain = CollectConfig(task=BLOCK, episodes=2, seed=6, out=out, workers=1, control=True)
    return dataclasses.replace(plain, **changes)  # type: ignore[arg-type]


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.glob("*.parquet")}


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two demonstrations of the quickest task."""
    out = tmp_path_factory.mktemp("demos")
    report = collect(config(out))
    assert (report.successes, report.mean_score) == (2, 1.0)
    return out


@pytest.fixture(scope="module")
def swing(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One swing, with pictures."""
    out = tmp_path_factory.mktemp("swing")
    changes = {"task": "whip-target", "episodes": 1, "evaluations": 250, "pictures": True}
    assert collect(config(out, seed=1, **changes)).successes == 1
    return out


def assert_repeats(env: gymnasium.Env, episode: Episode) -> None:
    """The environment, told the recorded actions as float32, gives the recorded bits."""
    steps = episode.steps
    _, info = env.reset(seed=episode.info.seed)
    assert info["state_hash"] == steps[0].state_hash
    assert {step.outcome for step in steps[:-1]} == {"led"}, "as docs/dataset.md says"
    for before, after in itertools.pairwise(steps):
        seen, reward, terminated, truncated, info = env.step(np.array(before.action, np.float32))
        tip = env.unwrapped.worlds.episodes[0].tip
        assert info["state_hash"] == after.state_hash
        assert (info["score"], info["success"]) == (after.score, after.success)
        assert after.control is not None and after.control.reward == reward
        assert after.control.holding == info["holding"] and np.array_equal(after.control.tip, tip)
        if after.color.size:
            assert np.array_equal(seen["pixels"]["top"], after.color)
    assert terminated or truncated


def test_recorded_actions_repeat_the_states_in_the_environment(demos: Path) -> None:
    env = gymnasium.make("WarpDeform/BlockNotarget-Control-v1", control_mode="tip_delta_pose")
    for episode in EpisodeReader(demos, control=True):
        assert_repeats(env, episode)
        record = episode.info.control
        assert record is not None and record.mode == "tip_delta_pose" and record.horizon == 200
        assert [step.success for step in episode.steps[-5:]] == [True] * 5
        for step in episode.steps[:-1]:
            assert step.action is not None and np.abs(step.action).max() <= 1
            assert np.array_equal(step.action, step.action.astype(np.float32))
        assert episode.steps[0].action is not None and episode.steps[0].action[:3].any()


def test_a_swing_repeats_as_well_and_pictures_are_those_of_the_environment(swing: Path) -> None:
    env = gymnasium.make("WarpDeform/WhipTarget-v1", obs_mode="rgb")
    episode = EpisodeReader(swing, control=True).read(EpisodeReader(swing).seeds[0])
    assert episode.info.demonstrator == "cem" and episode.info.actions == 20
    assert_repeats(env, episode)
    aimed = env.unwrapped.worlds.episodes[0].layout.targets
    assert np.array_equal(episode.info.control.goal, aimed)


def test_replay_finds_nothing_in_any_order_and_finds_one_changed_bit(
    demos: Path, tmp_path: Path
) -> None:
    assert verify(demos, workers=1)["mismatches"] == 0
    reader = EpisodeReader(demos, control=True)
    episode = reader.read(SEEDS[0])
    action = episode.steps[3].action
    assert action is not None
    changed = np.nextafter(action.astype(np.float32), np.float32(0)).astype(float)
    steps = (*episode.steps[:3], dataclasses.replace(episode.steps[3], action=changed))
    EpisodeWriter(tmp_path).write(dataclasses.replace(episode, steps=(*steps, *episode.steps[4:])))
    EpisodeWriter(tmp_path).write(reader.read(SEEDS[1]))
    found = verify(tmp_path, workers=1)
    assert 0 < found["mismatches"] <= episode.info.actions - 3 and found["episodes"] == 2
    assert 0 < found["max_error"] < 1e-3
    assert verify(tmp_path, tolerance=0.001, workers=1)["mismatches"] == 0


def test_growing_keeps_what_was_there_and_a_file_survives_reading(
    demos: Path, tmp_path: Path
) -> None:
    collect(config(tmp_path, episodes=1))
    assert set(files(tmp_path)) < set(files(demos))
    collect(config(tmp_path))
    assert files(tmp_path) == files(demos)
    copies = tmp_path / "copies"
    for episode in EpisodeReader(demos, control=True):
        assert episode.info.format == CONTROL_FORMAT
        EpisodeWriter(copies).write(episode)
    assert files(copies) == files(demos)


def test_a_film_shows_every_row_and_the_goal_of_a_swing(
    demos: Path, swing: Path, tmp_path: Path
) -> None:
    import imageio.v2 as imageio

    path = tmp_path / "film.mp4"
    film_control([demos, demos], path, seeds=[6], names=["one", "two"], size=(90, 160))
    frames = np.stack([np.asarray(frame) for frame in imageio.get_reader(path)])
    steps = EpisodeReader(demos, control=True).read(6).info.actions
    seconds = steps / 20 + 2 * STILL_SECONDS
    assert frames.shape[1:] == (90, 320, 3)
    assert len(frames) / FPS == pytest.approx(seconds, abs=2.5 / FPS)
    halves = frames[:, 30:, :160].astype(int), frames[:, 30:, 160:].astype(int)
    assert np.abs(halves[0] - halves[1]).mean() < 2.0
    moved = np.abs(np.diff(halves[0], axis=0)).max(axis=(1, 2, 3))
    still = round(STILL_SECONDS * FPS)
    assert (moved[2 : still - 2] < 40).all() and np.median(moved[still:-still]) > 60
    seed = EpisodeReader(swing).seeds[0]
    film_control([swing], path, seeds=[seed], size=(270, 480))
    red, green, blue = (np.asarray(imageio.get_reader(path).get_data(0)).astype(int)[..., :3]).T
    assert ((green > red + 60) & (green > blue + 60)).sum() >= 2, "the target is a green dot"


def test_a_film_of_what_is_no_control_or_starts_otherwise_is_refused(
    demos: Path, tmp_path: Path
) -> None:
    episode = EpisodeReader(demos, control=True).read(6)
    first = dataclasses.replace(episode.steps[0], state_hash="0" * 32)
    other = tmp_path / "other"
    EpisodeWriter(other).write(dataclasses.replace(episode, steps=(first, *episode.steps[1:])))
    with pytest.raises(WarpDeformError, match="start of seed 6 comes out differently"):
        film_control([other], tmp_path / "film.mp4", seeds=[6])
    picks = tmp_path / "picks"
    collect(CollectConfig(task=BLOCK, episodes=1, seed=6, out=picks, workers=1))
    with pytest.raises(InputError, match="no control at a fixed rate"):
        film_control([picks], tmp_path / "film.mp4", seeds=[EpisodeReader(picks).seeds[0]])
    assert not list(tmp_path.glob("*film*"))


def test_what_takes_picks_and_places_refuses_control_in_one_line(
    demos: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(InputError, match="holds control at a fixed rate"):
        EpisodeReader(demos).read(6)
    assert main(["inspect", str(demos)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "picks and places are needed" in said


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--horizon", "30"], "--horizon goes with --control"),
        (["--pictures"], "--pictures goes with --control"),
        (["--control", "--demonstrator", "mpc"], "scripted or visible"),
        (["--control", "--video", "f.gif"], "must end with .mp4"),
        (["--control", "--control-mode", "tip_velocity"], "tip_velocity"),
    ],
)
def test_bad_input_is_one_line_and_leaves_no_folder(
    words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main(["demo", BLOCK, "-n", "1", "--out", str(out), *words]) == 2
    error = capsys.readouterr().err
    assert said in error and "Traceback" not in error and not out.exists()


def test_a_swing_has_no_choices_and_no_other_task_is_led_by_its_velocity(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no choice of --start"):
        config(tmp_path, task="whip", start="held")
    with pytest.raises(InputError, match="a search demonstrates whip, and nobody else"):
        config(tmp_path, task="whip", demonstrator="visible")
    with pytest.raises(InputError, match="played with a jaw"):
        config(tmp_path, task="cable-mask-goal")
    with pytest.raises(InputError, match="demonstrations are made in"):
        TipDemonstrator(ControlWorlds("whip", 8, control_mode="tip_velocity", lanes=8))


@pytest.mark.parametrize("task", ["fold-fabric-1", "fold-fabric-3"])
def test_folds_are_demonstrated_and_end_on_the_table(task: str, tmp_path: Path) -> None:
    """A straight pick and place, as other tasks are demonstrated, folds none of them."""
    together = collect(config(tmp_path / "both", task=task, seed=3))
    assert (together.attempts, together.successes) == (2, 2)
    alone = collect(config(tmp_path / "one", task=task, seed=4, episodes=1))
    assert alone.successes == 1 and verify(tmp_path / "one", workers=1)["mismatches"] == 0
    (name, kept), *_ = sorted(files(tmp_path / "one").items())
    assert files(tmp_path / "both")[name] == kept, "a carry depends on its seed alone"
    episode = EpisodeReader(tmp_path / "one", control=True).read(4)
    last = episode.steps[-1]
    assert last.success and last.particle_q[:, 2].max() < 0.03 and episode.info.demonstrator
    first, second = (
        EpisodeReader(tmp_path / "both", control=True).read(seed).steps[30].action
        for seed in (3, 4)
    )
    assert not np.array_equal(first, second)


def test_an_unfolding_is_demonstrated(tmp_path: Path) -> None:
    """Straight picks and places unfolded none in a hundred attempts."""
    report = collect(config(tmp_path, task="unfold-fabric-1", seed=0, episodes=1))
    assert report.successes == 1
    (name,) = files(tmp_path)
    seed = int(name.split("_")[1].split(".")[0])
    last = EpisodeReader(tmp_path, control=True).read(seed).steps[-1]
    assert last.success and last.particle_q[:, 2].max() < 0.01


def test_folds_have_no_other_demonstrator(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="carries of corners demonstrate fold-fabric-1, and nob"):
        config(tmp_path, task="fold-fabric-1", demonstrator="visible")
    for name, value in (("start", "held"), ("horizon", 30), ("control_mode", "tip_delta_pose")):
        with pytest.raises(InputError, match=f"no choice of --{name.replace('_', '-')}"):
            config(tmp_path, task="fold-fabric-3", **{name: value})


def row(success: bool) -> Step:
    empty = np.zeros((0, 3), np.float32)
    return Step(
        np.zeros((0, 0, 3), np.uint8), np.zeros((0, 0), np.float32), None, 0.0, success, True,
        0.0, "", None, empty, empty, empty, empty, empty[0:0, 0],
    )  # fmt: skip


def test_the_idle_end_is_cut_and_nothing_else() -> None:
    go, stay, release = (
        np.array([1.0, 0, 0, 1]),
        np.array([0, 0, 0, 1.0]),
        np.array([0, 0, 0, -1.0]),
    )
    for told, solved, kept in (
        ([go, stay, stay], [False, True, True, True], 1),
        ([stay, go, stay], [False, False, True, True], 2),
        ([go, release], [False, False, True], 2),
        ([go, stay, stay], [False, False, True, True], 2),
        ([go, stay], [False, False, False], 2),
    ):
        run = without_idle_end(ControlEpisode(0, [row(s) for s in solved], told, "solved"))
        assert len(run.actions) == kept and len(run.rows) == kept + 1


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda e: with_extra(e, {}), "how the tip was led"),
        (lambda e: with_extra(e, {CONTROL: {**e.info.extra[CONTROL], "rate": 0.0}}), "above 0"),
        (lambda e: with_extra(e, {CONTROL: {**e.info.extra[CONTROL], "shape": [7]}}), "shape"),
        (lambda e: with_first(e, action=2 * np.ones(5)), "within -1 to 1"),
        (lambda e: with_first(e, action=np.ones(4)), r"shape \(4,\)"),
        (lambda e: with_first(e, control=None), "a tip belongs"),
        (lambda e: with_first(e, color=np.zeros((2, 2, 3), np.uint8)), "without pictures"),
    ],
)
def test_what_is_not_whole_is_not_written(change, said: str, demos: Path, tmp_path: Path) -> None:
    episode = EpisodeReader(demos, control=True).read(6)
    with pytest.raises(InputError, match=said):
        EpisodeWriter(tmp_path).write(change(episode))
    assert not files(tmp_path)


def with_extra(episode: Episode, extra: dict) -> Episode:
    return dataclasses.replace(episode, info=dataclasses.replace(episode.info, extra=extra))


def with_first(episode: Episode, **changes: object) -> Episode:
    first = dataclasses.replace(episode.steps[0], **changes)  # type: ignore[arg-type]
    return dataclasses.replace(episode, steps=(first, *episode.steps[1:]))


def test_what_holds_a_box_is_searched_among_its_episodes(tmp_path: Path) -> None:
    """A swing puts back no boxes; gather and push-cable begin with a search all the same."""
    with pytest.raises(InputError, match="gather has bodies"):
        SwingProblem("gather", [0], worlds=8)
    out = tmp_path / "demos"
    settings = CollectConfig(
        task="push-cable", episodes=1, out=out, workers=1, control=True, evaluations=25
    )
    with pytest.raises(InputError, match="a search demonstrates push-cable, and nobody else"):
        collect(dataclasses.replace(settings, demonstrator="visible"))
    (attempt,) = itertools.islice(attempt_control_chunk(ControlChunk(settings, out, (0,))), 1)
    assert attempt.actions == 120 and 0.6 < attempt.score < 1.0, "an untouched cable has 0.57"
