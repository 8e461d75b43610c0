"""Corrected episodes: the policy's actions replay, the teacher's labels are learned."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fixtures.short_runs import TASK, said, settle
from fixtures.training_samples import write_demonstrations

from learning.correction import correct as correcting
from learning.correction.correct import CorrectConfig, CorrectReport, correct
from learning.data.batches import task_lifts
from learning.data.dataset import Demonstrations
from learning.runs.folder import RunFolder
from learning.training.config import TrainConfig
from learning.training.schedules import Schedule
from learning.training.train import train
from warp_deform.collecting.collect import CollectConfig, collect
from warp_deform.collecting.goals import CONSTRUCTED
from warp_deform.collecting.inspection import contact_sheet
from warp_deform.collecting.make_goals import make_goals
from warp_deform.collecting.replay import verify
from warp_deform.command.main import main
from warp_deform.episodes import EpisodeReader, EpisodeWriter, episode_name, read_index
from warp_deform.episodes.corrected import CORRECTION, corrector, labels_of
from warp_deform.errors import InputError
from warp_deform.tasks.registry import task as find_task
from warp_deform.tasks.task import Task

NEW = (2, 3, 4)
"""Seeds of the corrected episodes; the run learned from 0 and 1."""


@pytest.fixture(scope="module")
def corrected(trained: Path, tmp_path_factory: pytest.TempPathFactory) -> CorrectReport:
    """A run that knows nothing, corrected by the scripted demonstrator."""
    out = tmp_path_factory.mktemp("corrected") / "data"
    return correct(
        CorrectConfig(run=trained, teacher="scripted", episodes=len(NEW), out=out, workers=1)
    )


def new_ones(report: CorrectReport, folder: Path) -> Path:
    """A folder with the corrected episodes alone: the others are synthetic."""
    folder.mkdir()
    for seed in NEW:
        shutil.copy(Path(report.out) / episode_name(seed), folder)
    return folder


def test_the_report_counts_labels_beside_demonstrations(corrected: CorrectReport) -> None:
    reader = EpisodeReader(Path(corrected.out))
    assert reader.seeds == (0, 1, *NEW)
    assert (corrected.episodes, corrected.corrected, corrected.before) == (3, 3, 2)
    actions = {info.seed: info.actions for info in reader.infos()}
    assert corrected.labels == sum(actions[seed] for seed in NEW) > 0
    assert corrected.before_labels == actions[0] + actions[1]
    per_demonstration = corrected.before_labels / corrected.before
    assert corrected.equal_demonstrations == pytest.approx(corrected.labels / per_demonstration)


def test_actions_replay_and_labels_are_the_teachers(
    corrected: CorrectReport, tmp_path: Path
) -> None:
    checked = verify(new_ones(corrected, tmp_path / "new"), workers=1)
    assert (checked["episodes"], checked["mismatches"]) == (len(NEW), 0)
    shown = tmp_path / "shown"
    collect(CollectConfig(task=TASK, episodes=len(NEW), seed=NEW[0], out=shown, workers=1))
    for seed in NEW:  # where both start alike, the teacher does what it would have demonstrated
        info = EpisodeReader(Path(corrected.out)).info(seed)
        assert info.demonstrator == corrector("scripted") and not info.extra.get("refinement")
        first = labels_of(info, what=seed)[0]
        np.testing.assert_array_equal(first, EpisodeReader(shown).read_step(seed, 0).action)
        played = EpisodeReader(Path(corrected.out)).read_step(seed, 0).action
        assert np.abs(first - played).max() > 0.001


def test_training_learns_labels_for_the_goal_that_was_asked_for(corrected: CorrectReport) -> None:
    folder = Path(corrected.out)
    data = Demonstrations(folder, task=TASK)
    assert data.corrected == len(NEW) and sum(data.lengths()) == (
        corrected.labels + corrected.before_labels
    )
    episode = EpisodeReader(folder).read(NEW[0])
    assert episode.goal is not None and not np.array_equal(
        episode.goal.color, episode.steps[-1].color
    )
    number = data.seeds.index(NEW[0])
    for t, label in enumerate(labels_of(episode.info, what=folder)):
        transition = data.transition(number, t)
        np.testing.assert_array_equal(transition.action, label)
        np.testing.assert_array_equal(transition.color, episode.steps[t].color)
        np.testing.assert_array_equal(transition.goal_color, episode.goal.color)
        state, _ = data.state(number, t)
        np.testing.assert_array_equal(state, episode.steps[t].ground_truth)


def test_states_without_a_label_are_left_out(corrected: CorrectReport, tmp_path: Path) -> None:
    episode = EpisodeReader(Path(corrected.out)).read(NEW[0])
    label = episode.info.extra[CORRECTION]["labels"][0]
    steps = (episode.steps[0], *episode.steps)

    def written(folder: str, labels: list[object]) -> Path:
        story = {**episode.info.extra[CORRECTION], "labels": labels}
        extra = {**episode.info.extra, CORRECTION: story}
        info = replace(episode.info, actions=episode.info.actions + 1, extra=extra)
        EpisodeWriter(tmp_path / folder).write(replace(episode, info=info, steps=steps))
        return tmp_path / folder

    rest = [label] * episode.info.actions
    assert Demonstrations(written("some", [None, *rest]), task=TASK).lengths() == [len(rest)]
    with pytest.raises(InputError, match="holds no label"):
        Demonstrations(written("none", [None] * (len(rest) + 1)), task=TASK)
    with pytest.raises(InputError, match="no label for each"):
        Demonstrations(written("few", rest), task=TASK)
    for number, wrong in enumerate(([1.0] * 6, [True] * 7, "action", {})):
        with pytest.raises(InputError, match="no action of 7"):
            Demonstrations(written(f"wrong{number}", [wrong, *rest]), task=TASK)


def test_what_no_agent_can_learn_is_no_label() -> None:
    task = find_task(TASK)
    good = np.array([0.5, 0.0, 0.0, 0.5, 0.1, 0.0, task_lifts(task)[0]])
    assert np.array_equal(correcting._learnable(good, task), good)
    assert correcting._learnable(None, task) is None
    for column, value in ((0, 9.0), (4, -9.0), (6, 0.123)):
        bad = good.copy()
        bad[column] = value
        assert correcting._learnable(bad, task) is None


@pytest.mark.in_a_row("workers")
def test_parts_interruptions_and_workers_change_no_bit(
    trained: Path, corrected: CorrectReport, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = CorrectConfig(run=trained, teacher="scripted", episodes=1, out=tmp_path / "a")
    correct(replace(config, workers=1))
    write, written = EpisodeWriter.write, []

    def interrupted(self: EpisodeWriter, episode: object) -> Path:
        if written:
            raise KeyboardInterrupt
        written.append(write(self, episode))
        return written[0]

    monkeypatch.setattr(EpisodeWriter, "write", interrupted)
    with pytest.raises(KeyboardInterrupt):
        correct(replace(config, episodes=3, workers=1))
    monkeypatch.undo()
    assert EpisodeReader(tmp_path / "a").seeds == (0, 1, 2, int(written[0].stem[-9:]))
    again = correct(replace(config, episodes=3, workers=2))
    assert again.state_hash == corrected.state_hash
    for seed in NEW:
        name = episode_name(seed)
        assert (tmp_path / "a" / name).read_bytes() == (Path(corrected.out) / name).read_bytes()
    assert correct(replace(config, episodes=2)).corrected == 2  # the third goes to the surplus
    assert EpisodeReader(tmp_path / "a").seeds == (0, 1, 2, 3)


def test_a_round_goes_on_from_weights_and_data_of_the_one_before(
    run: RunFolder, corrected: CorrectReport, tmp_path: Path
) -> None:
    def again(name: str, start: Path | None, steps: int = 1) -> tuple[Path, str]:
        out = tmp_path / name
        schedule = Schedule(steps=steps, batch=4, lr=1e-3, snapshots=1)
        report = train(
            TrainConfig(task=TASK, agent="gt-mlp", data=Path(corrected.out), out=out,
                        preset="fast", schedule=schedule, start=start, untrained=True)
        )  # fmt: skip
        assert (report.demos, report.corrected) == (5, 3)
        assert report.labels == corrected.labels + corrected.before_labels
        return out, report.weights_hash

    first, weights = again("first", run.path)
    assert again("twice", run.path)[1] == weights != again("anew", None)[1]
    before, begun = (RunFolder(each) for each in (run.path, first))
    last = before.snapshot(before.steps()[-1])
    assert begun.snapshot(0).read_bytes() == last.read_bytes()
    settings = begun.read_settings()
    assert settings["corrected"] == 3 and settings["labels"] > 3
    with pytest.raises(InputError, match="another start"):
        again("first", None)
    report = correct(
        CorrectConfig(run=first, teacher="scripted", episodes=1, out=tmp_path / "second", workers=1)
    )
    assert EpisodeReader(Path(report.out)).seeds == (0, 1, *NEW, 5)
    assert report.before == 5 and report.before_labels == corrected.labels + corrected.before_labels


def test_a_start_of_another_agent_is_refused(
    trained: Path, corrected: CorrectReport, tmp_path: Path
) -> None:
    config = TrainConfig(
        task=TASK, agent="gt-mlp-2step", data=Path(corrected.out), out=tmp_path / "r",
        preset="fast", start=trained, steps=1, snapshots=1, validate=0,
    )  # fmt: skip
    with pytest.raises(InputError, match="another agent than this run"):
        train(config)
    with pytest.raises(InputError, match="holds no training run"):
        train(replace(config, start=tmp_path))
    assert not (tmp_path / "r").exists()


def test_bad_input_is_one_line_and_leaves_nothing(
    run: RunFolder, corrected: CorrectReport, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, data = tmp_path / "new" / "out", tmp_path / "data"
    shutil.copytree(corrected.out, data)

    def refused(*flags: str, run: Path = run.path) -> str:
        line = said(capsys, "correct", str(run), "--out", str(out), "--teacher", "scripted", *flags)
        assert not out.parent.exists()
        return line

    assert "holds no training run" in refused(run=tmp_path)
    assert "seed 1 is one that" in refused("--seed", "1")
    assert "test seeds" in refused("--seed", "9990")
    assert "name the folder that does by --data" in refused("--data", str(
        write_demonstrations(tmp_path / "others", 2, task="cable-line-notarget")))  # fmt: skip
    assert "what" in refused("--data", str(tmp_path / "nowhere"))
    assert "invalid" in refused("--teacher", "nobody").lower()
    assert "--episodes" in refused("-n", "0")
    own = ["correct", str(run.path), "--teacher", "scripted", "--data", str(data)]
    assert "give --out another one" in said(capsys, *own, "--out", str(data))
    settle(run, data=None)
    assert "give it by --data" in refused()
    settings = json.loads(run.settings.read_text())
    settle(run, schedule={**settings["schedule"], "steps": 9})
    assert "trained for 2 of 9" in refused("--data", str(data))


def test_a_teacher_that_has_nothing_to_say_is_refused(
    trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(type(find_task(TASK)), "demonstrate", lambda *_: None)
    out = tmp_path / "out"
    with pytest.raises(InputError, match="scripted has nothing to say of block-notarget"):
        correct(CorrectConfig(run=trained, teacher="scripted", episodes=1, out=out, workers=1))
    assert not out.exists()


def test_goals_that_are_given_are_played_for_and_learnt(
    trained: Path, corrected: CorrectReport, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the seed's turn, whatever the parts, also those of the episodes' own seeds."""
    goals = made_goals(tmp_path / "goals", 2, seed=NEW[0])
    monkeypatch.chdir(tmp_path)
    config = CorrectConfig(
        run=trained, teacher="scripted", episodes=1, goals=Path("goals"), out=Path("a"), workers=1
    )
    correct(config)
    report = correct(replace(config, episodes=3, workers=2))
    whole = correct(replace(config, episodes=3, out=tmp_path / "b"))
    assert report.state_hash == whole.state_hash != corrected.state_hash and whole.corrected == 3
    reader = EpisodeReader(tmp_path / "a")
    for seed in NEW:
        goal = reader.read_goal(seed)
        assert goal is not None and goal.seed == NEW[0] + seed % 2
        wanted = EpisodeReader(goals).read(goal.seed)
        np.testing.assert_array_equal(goal.color, wanted.steps[-1].color)
    new = new_ones(report, tmp_path / "new")
    assert verify(new, workers=1)["mismatches"] == 0
    assert Demonstrations(new, task=TASK).given_goals == [NEW[0], NEW[0] + 1, NEW[0]]
    without = new_ones(corrected, tmp_path / "without")
    assert Demonstrations(without, task=TASK).given_goals == []
    data = Demonstrations(tmp_path / "a", task=TASK)
    shown = data.transition(data.seeds.index(3), 0)
    np.testing.assert_array_equal(shown.goal_color, reader.read(3).goal.color)
    for others in (None, made_goals(tmp_path / "others", 2, seed=200_001)):
        with pytest.raises(InputError, match="collection of another kind: goals"):
            correct(replace(config, goals=others))


def test_goals_that_no_agent_should_learn_with_are_refused(
    run: RunFolder, corrected: CorrectReport, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those to play for, and those of what the run has learned from, before anything is made."""
    config = CorrectConfig(run=run.path, teacher="scripted", episodes=2, out=tmp_path / "out")

    def refused(match: str, **changes: object) -> None:
        with pytest.raises(InputError, match=match):
            correct(replace(config, **changes))
        assert not (tmp_path / "out").exists()

    tests = made_goals(tmp_path / "tests", 1, seed=100_000)
    refused("of seed 100000, one of those of tests.*--seed 200000", goals=tests)
    refused("of seed 120000, one of those of tests.*choose another --seed", seed=120_000)
    refused("cannot be read as a folder of episodes", goals=tmp_path / "nowhere")
    refused("holds goals of cable-line", goals=write_demonstrations(
        tmp_path / "line", 1, task="cable-line-notarget"))  # fmt: skip
    monkeypatch.setattr(Task, "goal_shows_its_start", lambda task: True)
    refused("that a start makes itself shows the rest.*give goals by --goals")
    own = new_ones(corrected, tmp_path / "own")
    settle(run, data=str(own), demonstrations=seals(own))
    given = made_goals(tmp_path / "given", 1, seed=200_000)
    refused("episode_000000002.parquet is of its own start", goals=given)


def seals(folder: Path) -> dict[str, str]:
    """A folder's episodes as a run knows them."""
    return {str(each["seed"]): each["seal"] for each in read_index(folder)["episodes"].values()}


def made_goals(folder: Path, count: int, *, seed: int) -> Path:
    """Goals of the task, made of neighbouring seeds."""
    make_goals(TASK, folder, count=count, seed=seed, kind=CONSTRUCTED, workers=1)
    return folder


@pytest.mark.parametrize(
    "line", [["refine", "{}", "--out", "o"], ["convert", "{}", "o", "--to", "lerobot"]]
)
def test_verbs_that_know_no_labels_refuse_them(
    line: list[str], corrected: CorrectReport, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [str(tmp_path / "o") if w == "o" else w.format(corrected.out) for w in line]
    assert "holds corrected episodes (seed 2)" in said(capsys, *words)
    assert not (tmp_path / "o").exists()


def test_a_sheet_shows_both(corrected: CorrectReport, tmp_path: Path) -> None:
    import cv2

    episode = EpisodeReader(Path(corrected.out)).read(NEW[0])
    contact_sheet(episode, tmp_path / "both.png")
    plain = replace(episode, info=replace(episode.info, demonstrator="somebody"))
    contact_sheet(plain, tmp_path / "one.png")
    both, one = (cv2.imread(str(tmp_path / name)) for name in ("both.png", "one.png"))
    magenta = [
        (np.abs(each.astype(int) - (255, 90, 255)).max(-1) < 8).sum() for each in (both, one)
    ]
    assert magenta[0] > 5 and magenta[1] == 0


def test_the_verb_says_what_labels_are_worth(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main(["correct", str(trained), "--teacher", "scripted", "-n", "1", "--out", str(out),
                 "--workers", "1"]) == 0  # fmt: skip
    text = capsys.readouterr().out
    assert "labels by scripted in 1 of 1 episodes" in text
    assert "demonstrations hold as many actions" in text
