"""`warp-deform franka`: what its verbs print, write and refuse."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures.board_photographs import BOARD
from fixtures.franka_arm import Arm, episode
from fixtures.franka_episodes import ACTION, CALIBRATION, GOAL, chain, recorder
from fixtures.places import ROOT

import hardware.arm.robot as robot_module
from hardware import RobotError
from hardware.backends.panda import BUSY
from hardware.cameras.camera import CameraError
from hardware.command.franka import franka
from hardware.episodes.goals import read_goal, sampled_goal, write_goal
from hardware.recordings.scoring import StartAtGoal
from hardware.twin.look_server import LookServer, remote_look
from hardware.twin.twin import TwinLook
from hardware.vision.top_down_view import TopDownView
from warp_deform.command.main import _parse, main
from warp_deform.errors import InputError
from warp_deform.support.revision import running_revision


def run(capfd: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, dict[str, object], str]:
    code = main(["franka", *arguments, "--json"])
    said = capfd.readouterr()
    lines = said.out.splitlines()
    return code, json.loads(lines[-1]) if lines else {}, said.err


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of an episode of one action; nobody changes it."""
    folder = tmp_path_factory.mktemp("recorded") / "a"
    episode(folder, Arm(), [ACTION], max_actions=1)
    return folder


def test_a_dry_run_needs_nothing_and_moves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    robot = ("--robot", "panda", "--host", "10.0.0.1")
    code, data, said = run(capfd, "run", *robot, "--agent", "random", "--seed", "3")
    assert code == 0 and data["executed"] is False and data["actions"] <= 1
    assert data["folder"] == "franka-episodes/0000" and "dry run: move_linear" in said
    meta = json.loads(Path("franka-episodes/0000/episode.json").read_text())
    assert (meta["robot_id"], meta["camera_id"]) == ("panda 10.0.0.1", "sim")
    assert meta["revision"] == running_revision().described
    code, data, _ = run(capfd, "score", "franka-episodes/0000")
    assert code == 0 and data["n_episodes"] == 1


def test_a_folder_without_a_picture_does_not_hide_the_other_scores(
    tmp_path: Path, recorded: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    folders = [tmp_path / name for name in "abc"]
    for folder in (folders[0], folders[2]):
        shutil.copytree(recorded, folder)
    recorder(folders[1]).finish("stopped")
    code, data, said = run(capfd, "score", *map(str, folders))
    assert code == 2 and "1 of 3 folders cannot be scored" in said
    assert [row["folder"] for row in data["episodes"]] == [str(folders[0]), str(folders[2])]
    assert data["n_episodes"] == 2 and data["failed"][0]["folder"] == str(folders[1])
    assert main(["franka", "score", *map(str, folders)]) == 2
    lines = capfd.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[:3]] == [str(folder) for folder in folders]
    assert "before its first picture" in lines[1]


def test_collected_episodes_are_scored_and_replayed_and_those_of_run_with_their_seeds(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Toss, noise and draws: the second episode sees the pictures of `run --seed` bit by bit,
    before and after an action.
    """
    out, alone = tmp_path / "c", tmp_path / "r"
    options = ("--robot", "sim", "--agent", "random", "--max-actions", "1")
    code, data, _ = run(capfd, "collect", "-n", "2", "--seed", "7", *options, "--out", str(out))
    assert code == 0 and data["episodes"] == 2 and data["actions"] == 2
    assert data["demonstrations"] == 0 and not list(out.glob("*.parquet"))  # the goals are too far
    first, second = out / "live" / "0000", out / "live" / "0001"
    code, scored, _ = run(capfd, "score", str(first))
    assert code == 0 and len(scored["episodes"][0]["iou"]) == 2
    film = tmp_path / "plans.mp4"
    code, replayed, _ = run(capfd, "replay", str(first), "--video", str(film))
    assert code == 0 and replayed["mismatches"] == 0 and film.stat().st_size > 1000
    assert [row["iou"] for row in replayed["rows"]] == scored["episodes"][0]["iou"]
    assert run(capfd, "run", "--seed", "8", *options, "--out", str(alone))[0] == 0
    for name in ("frames/000_rgb.png", "frames/001_rgb.png"):
        assert (second / name).read_bytes() == (alone / name).read_bytes()
    start = "frames/000_rgb.png"
    assert (first / start).read_bytes() != (alone / start).read_bytes()


def test_a_replay_finds_a_changed_mask(
    tmp_path: Path, recorded: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    folder = shutil.copytree(recorded, tmp_path / "a")
    write_goal(
        folder / "frames" / "000_mask.png", np.zeros_like(GOAL), np.zeros((2, 2, 3), np.uint8)
    )
    (folder / "frames" / "000_mask.png").write_bytes(
        (folder / "frames" / "001_mask.png").read_bytes()[:-20]
    )
    assert run(capfd, "replay", str(folder))[0] == 2  # a damaged file
    import cv2

    grey = np.zeros(GOAL.shape, np.uint8)
    (folder / "frames" / "000_mask.png").write_bytes(cv2.imencode(".png", grey)[1].tobytes())
    code, data, said = run(capfd, "replay", str(folder))
    assert code == 1 and data["mismatches"] == 1 and "differ" in said


def tampered(folder: Path, name: str, change: Callable[[dict[str, Any]], None]) -> None:
    """Change the objects in a recording's file of JSON lines, or its only object."""
    path = folder / name
    text = path.read_text()
    rows = (
        [json.loads(text)] if name == "episode.json" else list(map(json.loads, text.splitlines()))
    )
    for row in rows:
        change(row)
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))


@pytest.mark.parametrize(
    ("name", "change", "message", "verbs"),
    [
        ("steps.jsonl", lambda row: row.update(iou=0.2), "overlap|recorded 0.2000", "both"),
        ("episode.json", lambda row: row.update(outcome="success"), "'success'", "both"),
        ("episode.json", lambda row: row.update(calibration="0" * 32), "calibration", "replay"),
    ],
    ids=["overlap", "outcome", "calibration"],
)
def test_what_is_recorded_and_computed_otherwise_is_exit_code_1(
    tmp_path: Path,
    recorded: Path,
    capfd: pytest.CaptureFixture[str],
    name: str,
    change: Callable[[dict[str, Any]], None],
    message: str,
    verbs: str,
) -> None:
    folder = shutil.copytree(recorded, tmp_path / "a")
    tampered(folder, name, change)
    for verb in ("score", "replay") if verbs == "both" else ("replay",):
        code, data, said = run(capfd, verb, str(folder))
        found = data["episodes"][0] if verb == "score" else data
        assert code == 1 and re.search(message, said) and "differ" in said
        assert found["differences"] and found["warnings"] == []
    code, data, said = run(capfd, "score", str(recorded), str(folder), str(tmp_path / "none"))
    assert code == 2 and len(data["episodes"]) == 2, "a folder that is none is bad input"


def test_what_is_computed_as_it_is_recorded_is_exit_code_0(
    recorded: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    for verb in ("score", "replay"):
        assert run(capfd, verb, str(recorded))[0] == 0


def test_an_episode_that_began_at_its_goal_is_counted_by_itself(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    begun, _ = episode(tmp_path / "a", Arm(), [ACTION], where=lambda: 0.50)
    assert isinstance(begun.error, StartAtGoal) and begun.outcomes == ()
    assert begun.outcome.startswith("error: StartAtGoal: the cable lies at its goal already")
    places = iter([0.45, 0.50])
    episode(tmp_path / "b", Arm(), [ACTION], where=lambda: next(places))
    code, data, _ = run(capfd, "score", str(tmp_path / "a"), str(tmp_path / "b"))
    assert code == 0 and (data["n_episodes"], data["n_success"], data["n_at_start"]) == (1, 1, 1)
    assert data["mean_actions_solved"] == 1.0
    assert run(capfd, "replay", str(tmp_path / "a"))[0] == 0


def test_a_goal_is_captured_and_read(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "goals" / "0.png"
    code, data, _ = run(capfd, "capture-goal", "--robot", "sim", "--seed", "5", "--out", str(file))
    assert code == 0 and data["pixels"] > 300 and Path(str(data["view"])).is_file()
    goal = read_goal(file, TopDownView())
    truth = sampled_goal(5)
    both, either = goal.mask & truth.mask, goal.mask | truth.mask
    assert both.sum() / either.sum() > 0.6
    assert goal.targets is not None and truth.targets is not None
    ways = [np.linalg.norm(goal.targets[::w] - truth.targets, axis=1).mean() for w in (1, -1)]
    assert min(ways) < 8e-3
    with pytest.raises(InputError, match="capture-goal"):
        write_goal(file, np.zeros_like(truth.mask), np.zeros((320, 160, 3), np.uint8))
        read_goal(file, TopDownView())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["run", "--robot", "panda", "--execute", "--host", "10.0.0.1"], "not an address of this"),
        (["run", "--robot", "sim", "--camera", "uvc"], "--camera sim"),
        (["run", "--camera", "uvc", "--setup", "nowhere"], "calibration"),
        (["run", "--agent", "policy"], "--policy"),
        (["run", "--agent", "policy", "--policy", "nowhere"], "nowhere"),
        (["run", "--robot", "ur5"], "--robot"),
        (["run", "--joint-speed", "0.9"], "--joint-speed is 0.9; allowed: 0.001 to 0.2"),
        (["collect"], "--out"),
        (["score"], "EPISODE|episode"),
        (["score", "nowhere"], "nowhere"),
        (["replay", "nowhere"], "nowhere"),
        (["emulate", "--chain", "1", "--table-z", "0.1"], "--chain excludes"),
        (["emulate", "--chain", "1", "--object-width", "0.02"], "--chain excludes"),
        (["emulate", "--chain", "one"], "chain"),
        (["emulate", "--chain"], "chain"),
        (["emulate", "--no-such-flag"], "no-such-flag"),
        (["emulate", "--host", "0.0.0.0"], "not an address of this machine"),
        (["calibrate", "table"], "--table-z"),
        (["calibrate", "table", "--table-z", "0.0"], "--execute"),
        (["calibrate", "points", "--points", "4"], "--points is 4; allowed: 5"),
        (["calibrate", "points", "--typed", "--setup", "nowhere"], r"table\.json"),
        (["calibrate", "points", "--pairs", "p.csv"], "whose are the points"),
        (["calibrate", "empty", "--setup", "nowhere"], "calibration"),
        (["calibrate", "nonsense"], "nonsense; available subcommands: board, lens, table"),
        (["calibrate", "board", "--table-z", "0"], "--table-z"),
        ([], "Expected one of"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_bad_input_is_one_line_and_exit_code_2(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    arguments: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["franka", *arguments]) == 2
    said = capfd.readouterr().err.strip().splitlines()
    assert re.search(message, said[-1]) and "Traceback" not in "".join(said)


def test_a_robot_that_is_not_there_is_exit_code_1(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    code = main(["franka", "run", "--robot", "panda", "--execute", "--host", "127.0.99.9"])
    assert code == 1 and "franka emulate" in capfd.readouterr().err


def test_doctor_explains_a_bare_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    code, data, _ = run(capfd, "doctor", "--setup", str(tmp_path))
    assert code == 0 and data["ready"] is True
    missing = {check["name"]: check["advice"] for check in data["checks"] if not check["ok"]}
    assert ".[panda]" in missing["panda-python"]
    assert ".[fr3]" in missing["franky-control"] and "calibrate" in missing["calibration"]
    code, data, said = run(capfd, "doctor", "--robot", "panda", "--setup", str(tmp_path))
    assert code == 1 and data["ready"] is False and "panda-python: not installed" in said
    CALIBRATION.save(tmp_path / "calibration.json")
    checks = run(capfd, "doctor", "--setup", str(tmp_path))[1]["checks"]
    assert next(c for c in checks if c["name"] == "calibration")["ok"] is True


WHERE = {"--setup"}
SEEN = {"--camera", "--device"}
PLACE = {"--robot", "--host", "--home", "--workspace"}
STEPS = {
    "board": WHERE | {"--square-mm"},
    "lens": WHERE | SEEN | {"--square-mm", "--views", "--size"},
    "table": WHERE | PLACE | {"--execute", "--table-z"},
    "camera": WHERE | SEEN | PLACE | {"--execute", "--square-mm", "--corners"},
    "points": WHERE | SEEN | PLACE | {"--execute", "--points", "--typed", "--pairs"},
    "hand": WHERE | SEEN | PLACE | {"--execute", "--square-mm", "--views"},
    "empty": WHERE | SEEN | PLACE,
}
"""Flags of each step of `calibrate`."""


@pytest.mark.parametrize("step", STEPS)
def test_a_step_of_calibrate_has_its_own_flags(
    step: str, capfd: pytest.CaptureFixture[str]
) -> None:
    assert main(["franka", "calibrate", step, "--help"]) == 0
    shown = set(re.findall(r"^\W*(--[a-z-]+)", capfd.readouterr().out, re.MULTILINE))
    assert shown == STEPS[step] | {"--json", "--task-module"}
    others = sorted(set.union(*STEPS.values()) - STEPS[step])
    words = [word for flag in others for word in (flag, "1")]
    assert main(["franka", "calibrate", step, *words]) == 2
    refused = re.findall(r"(--[a-z-]+) \(applied to", capfd.readouterr().err.splitlines()[-1])
    assert sorted(refused) == others


def test_the_documented_lines_of_calibrate_are_understood() -> None:
    text = (ROOT / "docs" / "hardware.md").read_text()
    lines = re.findall(r"^    warp-deform franka (calibrate .+)$", text, re.MULTILINE)
    assert {line.split()[1] for line in lines} == STEPS.keys()
    assert any("--pairs" in line for line in lines)
    for line in lines:
        words = line.replace("--table-z Z", "--table-z -0.02").split()
        assert _parse("warp-deform franka", franka, words) is not None, line


def test_the_board_is_written_at_its_size(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    code, data, _ = run(capfd, "calibrate", "board", "--setup", str(tmp_path))
    assert code == 0 and data["dots_an_inch"] == 254
    from hardware.cameras.camera import read_image

    height, width = read_image(tmp_path / "board.png", color=True).shape[:2]
    assert (width, height) == (BOARD.columns * 360, BOARD.rows * 360)


def test_a_look_crosses_processes_on_loopback_alone() -> None:
    look = TwinLook(chain(0.45), np.eye(4), 0.03, (4, 5))
    with LookServer(lambda: look, port=0) as server:
        seen = remote_look("127.0.0.1", port=server.port)
    np.testing.assert_array_equal(seen.beads, look.beads)
    assert (seen.gripper_width, seen.held) == (0.03, (4, 5))
    with pytest.raises(CameraError, match="franka emulate"):
        remote_look("127.0.0.1", port=server.port)
    with pytest.raises(InputError, match="this machine"):
        LookServer(lambda: look, host="0.0.0.0", port=0)


def test_the_documentation_names_every_error_and_says_what_was_not_tried() -> None:
    text = (ROOT / "docs" / "hardware.md").read_text()
    names = [
        name
        for name in vars(robot_module)
        if isinstance(getattr(robot_module, name), type)
        and issubclass(getattr(robot_module, name), RobotError)
    ]
    assert len(names) > 9 and [name for name in names if f"`{name}`" not in text] == []
    names = (
        "CameraError",
        "SegmentationError",
        "InputError",
        "PoorFit",
        "PhysicsError",
        "StartAtGoal",
    )
    for name in names:
        assert f"`{name}`" in text
    begins = ("accepts no motion", "after recovery", "the arm stands beyond", "too near its limit")
    assert [words for words in (*begins, BUSY) if words not in text] == []
    refused = ("no one point is to blame", "run the wrong way round", "the same command continues")
    assert [words for words in refused if words not in text] == []
    pictures = re.findall(r"\(images/([\w.]+)\)", text)
    assert len(pictures) == 5
    sizes = [(ROOT / "docs" / "images" / name).stat().st_size for name in pictures[:2]]
    assert max(sizes) < 60_000
    assert "ever run on a physical robot" in " ".join(text.split())
    assert text.index("## Safety first") < text.index("## What you need")
