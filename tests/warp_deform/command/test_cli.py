"""The command's promises: exit codes, one line on stderr, one JSON object on stdout."""

from __future__ import annotations

import ctypes
import json
import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from fixtures.episode_samples import make_episode

from warp_deform import __version__
from warp_deform.command import doctor
from warp_deform.command import main as cli
from warp_deform.command.main import CommandOptions, Outcome, Verb, main
from warp_deform.control import CONTROL_TASKS
from warp_deform.episodes import EpisodeWriter
from warp_deform.errors import InputError, WarpDeformError
from warp_deform.tasks.registration import register_environments
from warp_deform.tasks.registry import FURTHER_TASKS, TASKS


@dataclass(frozen=True, kw_only=True)
class StubOptions(CommandOptions):
    """A verb of these tests."""

    count: int = 3
    """How many."""


def noisy(options: StubOptions) -> Outcome:
    print("from python")
    ctypes.CDLL(None).printf(b"from c\n")
    return Outcome(
        data={"count": np.int64(options.count), "mean": np.float32(0.5), "out": Path("a")},
        text="three",
    )


def bad_input(options: StubOptions) -> Outcome:
    raise InputError("the value is\n  wrong")


def failing(options: StubOptions) -> Outcome:
    raise WarpDeformError("the simulation left the table")


def incomplete(options: StubOptions) -> Outcome:
    return Outcome(data={"mismatches": 2}, text="two", failure="2 of 3 steps differ")


def interrupted(options: StubOptions) -> Outcome:
    raise KeyboardInterrupt


def full_disk(options: StubOptions) -> Outcome:
    raise OSError(28, "No space left on device", "episode.parquet")


LISTED = {"name", "env_id", "goal_conditioned", "max_actions", "objects"}
PAPER = {
    "cable-ring": (False, 20),
    "cable-ring-notarget": (False, 20),
    "cable-shape": (False, 20),
    "cable-shape-notarget": (True, 20),
    "cable-line-notarget": (True, 20),
    "fabric-cover": (False, 2),
    "fabric-flat": (False, 10),
    "fabric-flat-notarget": (True, 10),
    "bag-alone-open": (False, 8),
    "bag-items-1": (False, 8),
    "bag-items-2": (False, 9),
    "bag-color-goal": (True, 8),
    "block-notarget": (True, 2),
}
"""Goal-conditioned, actions allowed. Source: Seita et al., ICRA 2021, table I and its code."""

STUBS = {
    function.__name__.replace("_", "-"): Verb(f"{__name__}:{function.__name__}", "a test")
    for function in (noisy, bad_input, failing, incomplete, interrupted, full_disk)
}


@pytest.fixture
def stubs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cli, "VERBS", {**cli.VERBS, **STUBS})


def single_line(text: str) -> bool:
    return text.endswith("\n") and text.count("\n") == 1 and "Traceback" not in text


@pytest.mark.parametrize("arguments", [[], ["--help"], ["-h"]])
def test_usage_names_every_verb(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 0
    said = capsys.readouterr().out
    assert all(f"  {name} " in said and verb.summary in said for name, verb in cli.VERBS.items())


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"warp-deform {__version__}\n"


@pytest.mark.parametrize("name", cli.VERBS)
def test_every_verb_explains_itself(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    left, explained = [name], 0
    while left:
        words = left.pop()
        assert main([*words.split(), "--help"]) == 0
        said = capsys.readouterr().out
        assert said.startswith(f"usage: warp-deform {words}")
        inner = re.search(r"{([a-z,-]+)}", said.splitlines()[0])
        if inner:
            left += [f"{words} {part}" for part in inner[1].split(",")]
        else:
            explained += 1
            assert "--json" in said and "--no-json" not in said, words
    assert explained == (14 if name == "franka" else 1)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["lst"], "did you mean `list`?"),
        (["zzz"], "use one of: list, demo"),
        (["--jsn"], "unknown verb '--jsn'"),
        (["list", "--jsn"], "--json"),
        (["list", "extra"], "Unrecognized options: extra"),
        (["demo"], "--out DIR"),
        (["demo", "cable-shap", "--out", "x"], "did you mean 'cable-shape'?"),
        (["demo", "zzz", "--out", "x"], "`warp-deform list`"),
        (["demo", "cable-shape", "--out", "x", "-n", "many"], "-n/--episodes"),
        (
            ["demo", "cable-shape", "--out", "x", "-n", "0"],
            "--episodes is 0; allowed: 1 to",
        ),
        (["demo", "cable-shape", "--out", "x", "--workers", "-1"], "--workers is -1"),
        (["demo", "cable-shape", "--out", "x", "--robot", "r2d2"], "'ur5', 'panda'"),
        (["demo", "cable-shape", "--out", "x", "--demonstrator", "oracle"], "'visible', 'mpc'"),
        (["replay", "no-such-folder", "--json"], "no folder 'no-such-folder'"),
        (["inspect", "no-such-folder"], "no folder 'no-such-folder'"),
        (["inspect", ".", "--sheets", "-1"], "--sheets is -1"),
        (["bench", "--scene", "rope"], "'cable', 'heap', 'ring', 'block'"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    arguments: list[str], expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert single_line(said.err)
    assert expected in said.err


@pytest.mark.usefixtures("stubs")
@pytest.mark.parametrize(
    ("verb", "code", "expected"),
    [
        ("bad-input", 2, "warp-deform: the value is wrong\n"),
        ("failing", 1, "warp-deform: the simulation left the table\n"),
        ("incomplete", 1, "warp-deform: 2 of 3 steps differ\n"),
        ("interrupted", 130, "warp-deform: interrupted"),
        ("full-disk", 1, "warp-deform: [Errno 28] No space left on device: 'episode.parquet'\n"),
    ],
)
def test_exit_code_of_a_failure(
    verb: str, code: int, expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([verb]) == code
    said = capsys.readouterr().err
    assert single_line(said)
    assert said.startswith(expected)


@pytest.mark.usefixtures("stubs")
def test_an_incomplete_run_still_reports(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["incomplete", "--json"]) == 1
    assert json.loads(capsys.readouterr().out) == {"mismatches": 2}


@pytest.mark.usefixtures("stubs")
def test_stdout_holds_the_report_alone(capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["noisy", "--json", "--count", "4"]) == 0
    said = capfd.readouterr()
    assert json.loads(said.out) == {"count": 4, "mean": 0.5, "out": "a"}
    assert said.out.count("\n") == 1
    assert "from python\n" in said.err
    assert "from c\n" in said.err

    assert main(["noisy"]) == 0
    assert capfd.readouterr().out == "three\n"


def test_the_shell_completes_verbs_flags_and_tasks(
    capfd: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """As bash does it: the words of a line are handed to the function that the script defines."""
    assert main(["--completion"]) == 0
    script = tmp_path / "completion.sh"
    script.write_text(capfd.readouterr().out)

    def completed(*line: str) -> list[str]:
        words = " ".join(f"'{word}'" for word in line)
        asked = f"COMP_WORDS=({words}); COMP_CWORD={len(line) - 1}; _warp_deform"
        run = ["bash", "-c", f'source {script}; {asked}; printf "%s\\n" "${{COMPREPLY[@]}}"']
        return subprocess.run(run, capture_output=True, text=True, check=True).stdout.split()

    assert completed("warp-deform", "re") == ["replay", "report", "refine"]
    assert completed("warp-deform", "replay", "demos", "--ver") == ["--verify"]
    assert completed("warp-deform", "demo", "cable-r") == ["cable-ring", "cable-ring-notarget"]
    assert "--hold-out" in completed("warp-deform", "train", "--")
    assert completed("warp-deform", "inspect", "cable-r") == []
    assert main(["list", "--tyro-print-completion", "bash"]) == 2
    assert "`warp-deform --completion`" in capfd.readouterr().err


def test_list_keeps_its_contract(capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["list", "--json"]) == 0
    listed = json.loads(capfd.readouterr().out)
    tasks = listed["tasks"]
    names = [task["name"] for task in tasks]
    assert names == [*TASKS, *FURTHER_TASKS]
    control = {task["name"]: task["env_id"] for task in listed["control_tasks"]}
    assert list(control) == list(CONTROL_TASKS)
    register_environments()
    assert all(gymnasium.spec(name).kwargs["task"] == task for task, name in control.items())
    assert [task["name"] for task in tasks if task["benchmark"]] == list(TASKS)
    # the paper's tasks come first, in its order; a task of anybody's own may follow
    paper = [name for name in PAPER if name in TASKS]
    assert names[: len(paper)] == paper
    for task in tasks:
        assert set(task) == {*LISTED, "benchmark"}
        assert task["env_id"].startswith("WarpDeform/")
        if task["name"] in PAPER:
            assert (task["goal_conditioned"], task["max_actions"]) == PAPER[task["name"]]
        assert task["objects"] and all(isinstance(name, str) for name in task["objects"])


def test_inspect_writes_statistics_and_sheets(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    writer = EpisodeWriter(tmp_path)
    for seed in (4, 2, 7):
        writer.write(make_episode(seed))
    assert main(["inspect", str(tmp_path), "--sheets", "2", "--json"]) == 0
    answer = json.loads(capfd.readouterr().out)
    assert answer["episodes"] == 3
    assert [Path(path).stem[-1] for path in answer["sheets"]] == ["2", "4"]
    assert all(Path(path).stat().st_size > 0 for path in answer["sheets"])
    assert main(["inspect", str(tmp_path), "--sheets", "0"]) == 0
    assert "0 of 3 episodes" in capfd.readouterr().out
    (tmp_path / "file").write_text("")
    assert main(["inspect", str(tmp_path), "--out", str(tmp_path / "file")]) == 2
    assert single_line(said := capfd.readouterr().err) and "--out" in said


def test_inspect_of_an_empty_folder_is_bad_input(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert main(["inspect", str(tmp_path)]) == 2
    assert "holds no episodes" in capfd.readouterr().err


def test_doctor_keeps_its_contract(capfd: pytest.CaptureFixture[str]) -> None:
    code = main(["doctor", "--json"])
    said = capfd.readouterr()
    answer = json.loads(said.out)
    assert answer["healthy"] is (answer["problems"] == [])
    assert code == (0 if answer["healthy"] else 1), answer["problems"]
    assert set(answer["versions"]) == {"warp-deform", *doctor.DEPENDENCIES}
    assert any(device.startswith("cpu") for device in answer["devices"])
    assert answer["cuda"] is any(device.startswith("cuda") for device in answer["devices"])
    assert answer["cores"] >= 1
    assert answer["memory_gb"] > 0.5
    assert Path(answer["kernel_cache"]["path"]).is_dir()
    assert answer["ffmpeg"]
    assert "Warp 1" not in said.err


def test_doctor_text_says_the_same(capfd: pytest.CaptureFixture[str]) -> None:
    main(["doctor"])
    said = capfd.readouterr().out
    assert "CUDA" in said
    assert "healthy" in said or "problem: " in said


def test_doctor_finds_a_package_that_hides_ours(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "hardware").mkdir()
    (tmp_path / "hardware" / "__init__.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "hardware", raising=False)
    report = doctor.report()
    assert not report["healthy"]
    assert [entry for entry in report["problems"] if "hides" in entry["problem"]]
    assert str(tmp_path) in doctor.render(report)

    monkeypatch.undo()
    monkeypatch.chdir(tmp_path)
    assert any("hardware" in line for line in doctor.report()["warnings"])


@pytest.mark.parametrize(("closed", "code"), [(">&-", 0), ("<&- >&- 2>&-", 0), (">/dev/full", 1)])
def test_streams_that_take_nothing(closed: str, code: int) -> None:
    command = f"{sys.executable} -m warp_deform list {closed}"
    run = subprocess.run(["sh", "-c", command], capture_output=True, text=True)
    said = "warp-deform: [Errno 28] No space left on device\n" if code else ""
    assert (run.returncode, run.stdout, run.stderr) == (code, "", said)


def test_a_home_that_cannot_be_written_to_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    environment = {"HOME": str(tmp_path / "file"), "PATH": os.environ["PATH"]}
    command = [sys.executable, "-m", "warp_deform", "doctor"]
    run = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert (run.returncode, run.stdout) == (1, "")
    assert single_line(run.stderr) and "WARP_CACHE_PATH" in run.stderr
