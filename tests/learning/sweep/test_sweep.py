"""A sweep: what the file may say, what is done once, and what an interruption costs."""

from __future__ import annotations

import fcntl
import json
from pathlib import Path
from typing import Any

import pytest
from fixtures.places import ROOT
from fixtures.training_samples import block_episode, write_demonstrations

from learning import sweep
from learning.runs.folder import RunFolder
from learning.sweep import Collecting, Evaluating, read_sweep, run_sweep
from warp_deform.command.main import main
from warp_deform.episodes import EpisodeWriter
from warp_deform.errors import InputError, WarpDeformError

TASK = "block-notarget"
GRID = """
out = "{root}/out"
tasks = ["block-notarget"]
agents = ["gt-mlp"]
demos = [1, 2]
seeds = [0, 1]
steps = 2
batch = 4
snapshots = 1
validate = 0
untrained = true
{more}
[demonstrations]
folder = "{root}/data"
[evaluation]
episodes = 1
validation_episodes = 1
"""


@pytest.fixture
def grid(tmp_path: Path) -> Path:
    """A file that describes four runs, and demonstrations for them."""
    write_demonstrations(tmp_path / "data" / TASK, 2, task=TASK)
    path = tmp_path / "grid.toml"
    path.write_text(GRID.format(root=tmp_path, more=""))
    return path


def files(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*.safetensors")}


def test_a_grid_is_run_once(grid: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sweep", str(grid), "--workers", "1", "--json"]) == 0
    said = capsys.readouterr()
    answer = json.loads(said.out)
    assert (answer["runs"], answer["skipped"], answer["failed"]) == (4, 0, [])
    assert said.err.count("of 1 solved") == 4
    out = grid.parent / "out"
    names = sorted(path.name for path in (out / "runs").iterdir())
    assert names == [f"{TASK}-gt-mlp-{n}-s{seed}" for n in (1, 2) for seed in (0, 1)]
    assert RunFolder(out / "runs" / names[0]).steps() == [0, 2]
    report = Path(answer["report"]).read_text()
    assert "| 0 1 | 0/2 |" in report and "demonstrations_block-notarget.png" in report
    before = files(out)

    def never(*_: Any, **__: Any) -> None:
        raise AssertionError

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sweep, "train", never)
        patch.setattr(sweep, "collect", never)
        again = run_sweep(read_sweep(grid), workers=1)
    assert again["skipped"] == 4 and files(out) == before


def test_an_interrupted_sweep_goes_on(grid: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C in the evaluation of the second run: the first one is done, the second is trained."""
    evaluate, played = sweep.evaluate_run, []

    def interrupted(path: Path, **options: Any) -> Any:
        played.append(path.name)
        if len(played) == 2:
            raise KeyboardInterrupt
        return evaluate(path, **options)

    monkeypatch.setattr(sweep, "evaluate_run", interrupted)
    assert main(["sweep", str(grid), "--workers", "1"]) == 130
    weights = files(grid.parent / "out")
    report = run_sweep(read_sweep(grid), workers=1)
    assert report["skipped"] == 1 and not report["failed"]
    assert played[1] == played[2] and len(set(played)) == 4
    after = files(grid.parent / "out")
    assert weights == {name: after[name] for name in weights}


def test_a_run_that_fails_stops_no_other(
    grid: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    train = sweep.train

    def diverging(config: Any) -> Any:
        if config.seed == 1:
            raise WarpDeformError("the loss is nan")
        return train(config)

    monkeypatch.setattr(sweep, "train", diverging)
    assert main(["sweep", str(grid), "--workers", "1", "--json"]) == 1
    said = capsys.readouterr()
    answer = json.loads(said.out)
    assert [each["error"] for each in answer["failed"]] == ["the loss is nan"] * 2
    assert "2 of 4 runs failed" in said.err.splitlines()[-1]
    assert "| 0 | 0/1 |" in Path(answer["report"]).read_text()


def test_a_run_that_breaks_stops_no_other(grid: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An error that nobody foresaw is named by its type, on one line."""
    train = sweep.train

    def broken(config: Any) -> Any:
        if config.seed == 1:
            raise RuntimeError("out of memory:\n  tried to allocate 2 GiB")
        return train(config)

    monkeypatch.setattr(sweep, "train", broken)
    report = run_sweep(read_sweep(grid), workers=1)
    said = [each["error"] for each in report["failed"]]
    assert said == ["RuntimeError: out of memory: tried to allocate 2 GiB"] * 2


def test_what_files_are_there_does_not_tell_that_a_collection_is_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A killed collection holds enough episodes, and not yet those that it would keep."""
    asked = []

    def collect(config: Any) -> None:
        asked.append(config.episodes)
        for seed in 0, 1:  # the first two successes; seed 2 had come in before seed 0
            writer.write(block_episode(seed, task=TASK))
        (config.out / "episode_000000002.parquet").unlink()

    monkeypatch.setattr(sweep, "collect", collect)
    path = tmp_path / "grid.toml"
    own = GRID.format(root=tmp_path, more="").replace(f'folder = "{tmp_path}/data"', "count = 2")
    path.write_text(own.replace("demos = [1, 2]", "demos = [2]").replace("[0, 1]", "[0]"))
    config = read_sweep(path)
    writer = EpisodeWriter(config.data(TASK), overwrite=True)
    for seed in 1, 2:
        writer.write(block_episode(seed, task=TASK))
    report = run_sweep(config, workers=1)
    assert asked == [2] and not report["failed"]
    settings = RunFolder(config.cells()[0].out).read_settings()
    assert set(settings["demonstrations"]) == {"0", "1"}


def test_device_and_validation_reach_the_runs(tmp_path: Path) -> None:
    path = tmp_path / "grid.toml"
    path.write_text(
        GRID.format(root=tmp_path, more='device = "cuda"\npatience = 2').replace(
            "validate = 0", "validate = 3"
        )
    )
    cells = read_sweep(path).cells()
    assert {(cell.device, cell.validate, cell.patience) for cell in cells} == {("cuda", 3, 2)}


def test_demonstrations_are_collected_where_they_are_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def collect(config: Any) -> None:
        asked.append((config.task, config.episodes, config.demonstrator))
        write_demonstrations(config.out, config.episodes, task=TASK)

    monkeypatch.setattr(sweep, "collect", collect)
    path = tmp_path / "grid.toml"
    text = GRID.format(root=tmp_path, more="").replace("demos = [1, 2]", "demos = [1]")
    more = '[demonstrations]\ncount = 3\ndemonstrator = "mpc"\n'
    path.write_text(text.replace("seeds = [0, 1]", "").replace("[demonstrations]\n", more))
    report = run_sweep(read_sweep(path), workers=1)
    assert asked == [(TASK, 3, "mpc")] and not report["failed"]


def test_two_sweeps_do_not_share_a_folder(grid: Path) -> None:
    config = read_sweep(grid)
    config.out.mkdir()
    with (config.out / "sweep.lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(InputError, match="another sweep"):
            run_sweep(config, workers=1)


def test_agents_go_with_the_tasks_that_they_fit(tmp_path: Path) -> None:
    path = tmp_path / "grid.toml"
    path.write_text(
        'out = "out"\ntasks = ["cable-ring", "block-notarget"]\n'
        'agents = ["transporter", "goal-split", "gt-mlp"]\ndemos = [1]\nlr = 1\n'
    )
    config = read_sweep(path)
    assert [(cell.task, cell.agent) for cell in config.cells()] == [
        ("cable-ring", "transporter"),
        ("cable-ring", "gt-mlp"),
        ("block-notarget", "goal-split"),
        ("block-notarget", "gt-mlp"),
    ]
    assert {cell.plan(1).lr for cell in config.cells()} == {1.0}
    assert config.cells()[0].plan(1).steps == 4000, "the preset's"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("steps = 2", "step = 2", "unknown key 'step'; did you mean 'steps'"),
        ("episodes = 1\n", "zzz = 1\n", "unknown key 'evaluation.zzz'; there are: episodes"),
        ('"block-notarget"', '"blok"', "no task 'blok'"),
        ('"gt-mlp"', '"mlp"', "no agent 'mlp'"),
        ('"gt-mlp"', '"transporter"', "none of the agents transporter fits block-notarget"),
        ("demos = [1, 2]", "", "'demos' is missing"),
        ("demos = [1, 2]", "demos = 1", "it must be a list, as in"),
        ("demos = [1, 2]", "demos = [0]", "demos is 0; it must be 1 or more"),
        ("demos = [1, 2]", "demos = []", "demos is []; it must name at least one"),
        ("seeds = [0, 1]", "seeds = [0, 0]", "seeds is [0, 0]; it must name at least one, and"),
        ("seeds = [0, 1]", "seeds = [0, -1]", "seeds is -1; it must be 0 or more"),
        ("\nepisodes = 1", "\nepisodes = 0", "evaluation.episodes is 0; it must be 1 or more"),
        ("[evaluation]", "count = 0\n[evaluation]", "demonstrations.count is 0; it must be 1"),
        ("batch = 4", 'device = "tpu"', "device is 'tpu'; it must be 'cpu' or 'cuda'"),
        ("batch = 4", "patience = 2", "patience is 2 and validate 0"),
        ("seeds = [0, 1]", "seeds = [true]", "it must be a whole number"),
        ("steps = 2", "steps = 1.5", "it must be a whole number"),
        ("snapshots = 1", "snapshots = 9", "snapshots is 9; with steps = 2 it must be 1 to 2"),
        ("untrained = true", "untrained = 1", "it must be true or false"),
        ("batch = 4", 'preset = "quick"', "preset is 'quick'"),
        ("[evaluation]", '[evaluation]\nstage_rule = "none"', "stage_rule is 'none'"),
        ("[evaluation]", '[evaluation]\nrobot = "r2"', "not 'r2'"),
        ("[demonstrations]", '[demonstrations]\ndemonstrator = "you"', "no demonstrator 'you'"),
        ("[demonstrations]", "[demonstrations", "no TOML file"),
        ("[evaluation]\nepisodes = 1\nvalidation_episodes = 1", "", None),
    ],
)
def test_a_wrong_file_is_told_of_in_one_line(
    old: str, new: str, message: str | None, grid: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = grid.read_text()
    assert old in text
    grid.write_text(text.replace(old, new))
    if message is None:  # sections may be left out
        assert read_sweep(grid).evaluation.episodes == 200
        return
    assert main(["sweep", str(grid)]) == 2
    said = capsys.readouterr().err
    assert message in said and said.count("\n") == 1 and "grid.toml" in said
    assert not (grid.parent / "out").exists()


def test_the_file_of_the_docs_is_right(tmp_path: Path) -> None:
    page = ROOT / "docs" / "learning.md"
    path = tmp_path / "grid.toml"
    path.write_text(page.read_text().split("```toml\n")[1].split("```")[0])
    config = read_sweep(path)
    # cable-ring with transporter and gt-mlp, cable-line-notarget with goal-stack and gt-mlp
    assert len(config.cells()) == 4 * 3 * 3
    assert config.evaluation == Evaluating() and config.demonstrations == Collecting(count=1000)


def test_a_missing_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sweep", str(tmp_path / "none.toml")]) == 2
    assert "cannot be read" in capsys.readouterr().err


@pytest.mark.parametrize("workers", ["0", "-1", "100000"])
def test_a_wrong_number_of_workers(
    workers: str, grid: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["sweep", str(grid), "--workers", workers]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_an_agent_that_learns_of_no_goal_stands_beside_those_that_do(tmp_path: Path) -> None:
    asked = GRID.format(root=tmp_path, more='preset = "fast"\ngoal = "own"')
    asked = asked.replace(TASK, "cable-mask-goal").replace("gt-mlp", 'goal-split", "traced')
    path = tmp_path / "grid.toml"
    path.write_text(asked)
    cells = read_sweep(path).cells()
    assert {(cell.agent, cell.goal) for cell in cells} == {("goal-split", "own"), ("traced", "end")}


def test_goals_of_the_start_s_own_are_refused_before_anything_is_collected(tmp_path: Path) -> None:
    asked = GRID.format(root=tmp_path, more='goal = "own"').replace(TASK, "bag-color-goal")
    path = tmp_path / "grid.toml"
    for text in (asked.replace(f'folder = "{tmp_path}/data"', "count = 2"), asked):
        path.write_text(text)
        with pytest.raises(InputError, match=r"goal of bag-color-goal .* demonstrations\.folder"):
            read_sweep(path)
    (tmp_path / "data" / "bag-color-goal").mkdir(parents=True)
    assert read_sweep(path).cells()[0].goal == "own"
