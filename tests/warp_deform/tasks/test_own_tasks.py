"""Tasks from elsewhere: registered in a process, named as a module, offered by a distribution."""

from __future__ import annotations

import importlib.util
import json
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import warp_deform
from warp_deform.command.main import main
from warp_deform.envs.env import PickPlaceEnv
from warp_deform.episodes import EpisodeReader
from warp_deform.errors import InputError
from warp_deform.robots.primitive import Stage
from warp_deform.solver import SolverConfig
from warp_deform.tasks import registry
from warp_deform.tasks.block import BlockNotarget
from warp_deform.tasks.cable_ring import CableRing
from warp_deform.tasks.ground_truth import Row
from warp_deform.tasks.registry import FURTHER_TASKS, all_tasks, is_known, task_of
from warp_deform.tasks.registry import task as find_task
from warp_deform.tasks.task import Task

BOX = '''
import numpy as np

from warp_deform.objects import BoxConfig, add_box
from warp_deform.tasks.demonstrators import pick_place
from warp_deform.tasks.ground_truth import Row, pose_rows
from warp_deform.tasks.task import Layout, Stage, Task


class BoxAway(Task):
    """The box has to lie beyond y = 0."""

    name = "box-away"
    max_actions = 2
    stages = (Stage(lift=0.10, speed=0.5),)
    success_score = 1.0
    ground_truth_rows = ((Row.POSE, 1),)
    objects = ("box",)

    def add_objects(self, builder):
        return (add_box(builder, BoxConfig(), (0.5, -0.2, 0.02)),)

    def sample(self, rng, space):
        at = [rng.uniform(0.4, 0.6), rng.uniform(-0.2, -0.1), 0.02, 0, 0, 0, 1]
        return Layout(np.zeros((0, 3)), np.array([at]), np.zeros(0), settle_seconds=0.2)

    def score(self, layout, snapshot):
        return float(snapshot.body_q[0, 1] > 0)

    def demonstrate(self, layout, snapshot, rng):
        box = snapshot.body_q[0, :3]
        return pick_place(box, np.array([box[0], 0.1]), stage=self.stages[0])

    def ground_truth(self, layout, snapshot):
        return pose_rows(snapshot.body_q[:, :2], 0.0).ravel()
'''


@pytest.fixture(autouse=True)
def _forget(forgets_tasks: None, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Nothing that a test registers, imports or puts on the path is left to the next."""
    monkeypatch.setattr(sys, "path", [*sys.path])
    modules = set(sys.modules)
    yield
    for name in set(sys.modules) - modules:
        if name.endswith("_tasks"):
            del sys.modules[name]


def install(folder: Path, distribution: str, points: str, **modules: str) -> None:
    """Put a distribution with modules and entry points of our group on Python's path."""
    about = folder / f"{distribution.replace('-', '_')}-1.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(f"[warp_deform.tasks]\n{points}\n")
    for name, text in modules.items():
        (folder / f"{name}.py").write_text(text)
    sys.path.insert(0, str(folder))


def reported(capfd: pytest.CaptureFixture[str], *words: object) -> dict[str, Any]:
    """The JSON object of a command that has to succeed."""
    code = main([*map(str, words), "--json"])
    said = capfd.readouterr()
    assert code == 0, said.err
    report: dict[str, Any] = json.loads(said.out)
    return report


def refused(capfd: pytest.CaptureFixture[str], *words: object) -> str:
    """The one line of a command that has to be refused as bad input."""
    assert main(list(map(str, words))) == 2
    said = capfd.readouterr().err
    assert said.count("\n") == 1
    return said


def box_away(folder: Path) -> type[Task]:
    """The class, as a user's script defines it: its module is no module to import."""
    path = folder / "script.py"
    path.write_text(BOX)
    spec = importlib.util.spec_from_file_location("__main__", path)
    assert spec is not None and spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    cls: type[Task] = script.BoxAway
    return cls


def test_an_installed_task_goes_the_whole_way(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Listed, collected by workers, filmed, replayed, looked at, learnt, tested and reported."""
    install(tmp_path / "site", "box-tasks", "box-away = box_tasks:BoxAway", box_tasks=BOX)
    assert "box_tasks" not in sys.modules
    entry = reported(capfd, "list")["tasks"][-1]
    assert entry == {
        "name": "box-away", "env_id": "WarpDeform/BoxAway-v1", "goal_conditioned": False,
        "max_actions": 2, "objects": ["box"], "benchmark": False,
    }  # fmt: skip

    demos, run, film = tmp_path / "demos", tmp_path / "run", tmp_path / "demo.mp4"
    made = reported(
        capfd, "demo", "box-away", "-n", 3, "--workers", 2, "--out", demos, "--video", film
    )
    assert (made["successes"], made["physics_ok"]) == (3, True)
    assert film.stat().st_size > 10_000
    assert EpisodeReader(demos).info(0).extra == {"task_class": "box_tasks:BoxAway"}
    assert reported(capfd, "replay", demos, "--verify")["mismatches"] == 0
    assert reported(capfd, "inspect", demos)["tasks"] == {"box-away": 3}

    how = ("--agent", "gt-mlp", "--steps", 2, "--batch", 2, "--snapshots", 1)
    assert reported(capfd, "train", "box-away", *how, "--data", demos, "--out", run)["steps"] == 2
    test = ("--episodes", 2, "--validation-episodes", 1, "--videos", 1)
    evaluation = reported(capfd, "eval", run, *test, "--video", tmp_path / "films")
    assert evaluation["test"]["n_episodes"] == 2 and len(evaluation["videos"]) == 2
    (cell,) = reported(capfd, "report", run)["cells"]
    assert (cell["task"], cell["paper"]) == ("box-away", None)


@pytest.mark.in_a_row("workers")
def test_a_task_of_a_script_reaches_the_workers(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Its module is the script, which no worker could import; nor is it imported by replay."""
    warp_deform.register_task(box_away(tmp_path))
    demos = tmp_path / "demos"
    made = reported(capfd, "demo", "box-away", "-n", 9, "--workers", 2, "--out", demos)
    assert made["successes"] == 9
    recorded = {info.extra["task_class"] for info in EpisodeReader(demos).infos()}
    assert recorded == {"__main__:BoxAway"}, "not of the class of that name in an earlier test"
    env = gymnasium.make("WarpDeform/BoxAway-v1")
    assert env.reset(seed=0)[1]["ground_truth"].shape == (3,)
    registry._REGISTERED.clear()
    for command in (["replay", demos, "--verify"], ["replay", demos, "--workers", 2]):
        said = refused(capfd, *command)
        assert "there is no task 'box-away' here; it was recorded of __main__:BoxAway" in said


def test_a_module_that_is_named_is_imported(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    text = f"{BOX}\nimport warp_deform\nwarp_deform.register_task(BoxAway)\n"
    (tmp_path / "named_tasks.py").write_text(text)
    named = ("--task-module", tmp_path / "named_tasks.py")
    assert "'box-away'" in refused(capfd, "goals", "box-away", "--out", tmp_path / "goals")
    said = refused(capfd, "goals", "box-away", "--out", tmp_path / "goals", *named)
    assert "box-away has no goal image" in said and not (tmp_path / "goals").exists()

    monkeypatch.chdir(tmp_path)
    del sys.modules["named_tasks"]
    registry._REGISTERED.clear()
    tasks = reported(capfd, "list", "--task-module", "named_tasks")["tasks"]
    assert [each["name"] for each in tasks if not each["benchmark"]] == [*FURTHER_TASKS, "box-away"]


@pytest.mark.parametrize(
    ("module", "text", "expected"),
    [
        ("missing.py", None, "there is no file 'missing.py'"),
        ("missing_tasks", None, "ModuleNotFoundError: No module named 'missing_tasks'"),
        ("broken_tasks.py", "import os\n1 / 0\n", "division by zero (broken_tasks.py, line 2)"),
        ("leaving_tasks.py", "raise SystemExit(3)", "SystemExit: 3"),
        ("json.py", "", "hidden by another module 'json'"),
    ],
)
def test_a_module_that_cannot_be_imported_is_one_line(
    module: str,
    text: str | None,
    expected: str,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    if text is not None:
        (tmp_path / module).write_text(text)
    assert expected in refused(capfd, "list", "--task-module", module)


@pytest.mark.parametrize(
    ("points", "text", "expected"),
    [
        ("box-away = odd_tasks:BoxAway", "1 / 0", "ZeroDivisionError: division by zero"),
        ("box-away = odd_tasks:BoxAway", "raise SystemExit", "SystemExit"),
        ("box-away = odd_tasks:BoxGone", BOX, "has no attribute 'BoxGone'"),
        ("box-away = odd_tasks:np", BOX, "is a class derived from Task"),
        ("box-gone = odd_tasks:BoxAway", BOX, "calls itself 'box-away'"),
        ("cable-ring = odd_tasks:BoxAway", BOX, "'cable-ring', as the package does"),
        ("Box Away = odd_tasks:BoxAway", BOX, "calls itself 'box-away'"),
    ],
)
def test_a_broken_distribution_is_one_line_that_names_it(
    points: str, text: str, expected: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    install(tmp_path, "odd-things", points, odd_tasks=text)
    name = points.split(" = ")[0]
    assert main(["list", "--json"]) == 0
    said = capfd.readouterr()
    listed = json.loads(said.out)
    (line,) = listed["warnings"]
    assert "odd-things" in line and expected in line
    assert said.err == f"warp-deform: warning: {line}\n"
    assert [task["name"] for task in listed["tasks"]][-1] == list(FURTHER_TASKS)[-1]
    main(["doctor", "--json"])
    assert line in json.loads(capfd.readouterr().out)["warnings"]
    if name != "cable-ring":
        said = refused(capfd, "demo", name, "-n", 1, "--out", tmp_path / "demos")
        assert expected in said and not (tmp_path / "demos").exists()


def test_a_name_that_two_distributions_offer_is_nobody_s(tmp_path: Path) -> None:
    for name in "one", "two":
        install(
            tmp_path / name,
            f"boxes-{name}",
            f"box-away = {name}_tasks:BoxAway",
            **{f"{name}_tasks": BOX},
        )
    with pytest.raises(InputError, match="boxes-one and boxes-two both offer a task 'box-away'"):
        find_task("box-away")
    assert is_known("box-away")
    known, wrong = all_tasks()
    assert "box-away" not in known and len(wrong) == 1


def test_a_task_that_its_module_registers_itself_is_taken_once(tmp_path: Path) -> None:
    text = f"import warp_deform\n{BOX.replace('class Box', '@warp_deform.register_task%class Box')}"
    install(tmp_path, "boxes", "box-away = self_tasks:BoxAway", self_tasks=text.replace("%", "\n"))
    assert find_task("box-away").name == "box-away"
    assert all_tasks()[1] == []
    shutil.rmtree(tmp_path)
    assert find_task("box-away").name == "box-away"


def variant(**attributes: Any) -> type[Task]:
    """BlockNotarget under another name, with other attributes."""
    return type("Variant", (BlockNotarget,), {"name": "variant", **attributes})


@pytest.mark.parametrize(
    ("task", "expected"),
    [
        (BlockNotarget(), "registered by its class"),
        (BlockNotarget, "cannot be called 'block-notarget'"),
        (int, "a class derived from Task, not <class 'int'>"),
        ("cable-ring", "not 'cable-ring'"),
        (type("Empty", (Task,), {"name": "empty"}), "does not implement add_objects, demonstrate,"),
        (variant(name="Variant"), "name is 'Variant'; it must be words of lower-case"),
        (variant(name="../x"), "name is '../x'"),
        (variant(name="a--b"), "name is 'a--b'"),
        (variant(name=3), "name is 3"),
        (variant(name="bag-items1"), "that of 'bag-items-1'"),
        (variant(stages=()), "stages is ()"),
        (variant(stages=(Stage(lift=1.0, speed=0.1),)), "each lift 0.04 to 0.4 m"),
        (variant(max_actions=0), "max_actions is 0; it must be a whole number"),
        (variant(max_actions=True), "max_actions is True"),
        (variant(max_actions=2.5), "max_actions is 2.5"),
        (variant(success_score="1"), "success_score is '1'; it must be a number"),
        (variant(success_score=float("nan")), "success_score is nan"),
        (variant(ground_truth_rows=()), "ground_truth_size is 0"),
        (variant(ground_truth_rows=((Row.POSE, 2),), ground_truth_size=5), "three numbers a row"),
        (variant(objects="block"), "objects is 'block'"),
        (variant(solver=SolverConfig), "it must be a SolverConfig"),
        (variant(goal_conditioned=1), "goal_conditioned is 1; it must be True or False"),
        (variant(place_yaws=0), "place_yaws is 0"),
        (type("Goal", (CableRing,), {"name": "goal", "goal_conditioned": True}), "goal_layout"),
        (variant(__init__=lambda self, size: None), "made without arguments"),
    ],
)
def test_what_is_no_task_is_refused_in_one_line(task: Any, expected: str) -> None:
    with pytest.raises(InputError) as caught:
        warp_deform.register_task(task)
    said = str(caught.value)
    assert expected in said and "\n" not in said
    assert registry._REGISTERED == {}


@pytest.mark.parametrize("rows", [[(Row.POSE, 1)], (Row.POSE, 1), ((Row.POSE, 0),), (("pose", 1),)])
@pytest.mark.parametrize("size", [{}, {"ground_truth_size": 3}])
def test_rows_of_another_form_are_refused(rows: Any, size: dict[str, int]) -> None:
    with pytest.raises(InputError, match=r"ground_truth_rows is .* pairs \(Row, number of rows\)"):
        warp_deform.register_task(variant(ground_truth_rows=rows, **size))


def test_a_class_takes_the_place_of_its_earlier_self_alone(tmp_path: Path) -> None:
    first, again = box_away(tmp_path), box_away(tmp_path)
    assert warp_deform.register_task(first) is first
    warp_deform.register_task(again)
    assert type(find_task("box-away")) is again
    first.__qualname__ = "Another"
    with pytest.raises(InputError, match="a task of __main__:BoxAway is; rename it"):
        warp_deform.register_task(first)
    assert type(find_task("box-away")) is again


def test_an_environment_takes_a_name_a_task_or_its_class() -> None:
    assert [task_of(each).name for each in ("cable-ring", CableRing(), CableRing)] == [
        "cable-ring"
    ] * 3
    for odd in (3, None, object, np.zeros(2), "cable"):
        with pytest.raises(InputError):
            PickPlaceEnv(odd)  # type: ignore[arg-type]


def second(text: str = BOX) -> str:
    """The same task, of version 2."""
    return text.replace("    max_actions", "    version = 2\n    max_actions")


def test_a_registered_task_has_the_id_of_its_version(tmp_path: Path) -> None:
    first = box_away(tmp_path)
    warp_deform.register_task(first)
    assert gymnasium.make("WarpDeform/BoxAway-v1").spec is not None
    first.version = 2
    warp_deform.register_task(first)
    ids = [each for each in gymnasium.registry if "BoxAway" in each]
    assert ids == ["WarpDeform/BoxAway-Control-v1", "WarpDeform/BoxAway-v2"]
    env = gymnasium.make("WarpDeform/BoxAway-v2")
    assert env.unwrapped.task.version == 2  # type: ignore[attr-defined]
    with pytest.raises(gymnasium.error.DeprecatedEnv):
        gymnasium.make("WarpDeform/BoxAway-v1")


def test_an_installed_task_has_the_id_of_the_version_that_its_entry_point_says(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    install(tmp_path, "new", "box-away-v2 = second_tasks:BoxAway", second_tasks=second())
    warp_deform.tasks.registration.register_environments()
    assert "second_tasks" not in sys.modules and is_known("box-away")
    assert "WarpDeform/BoxAway-v2" in gymnasium.registry
    assert "WarpDeform/BoxAway-v1" not in gymnasium.registry
    entry = reported(capfd, "list")["tasks"][-1]
    assert (entry["name"], entry["env_id"]) == ("box-away", "WarpDeform/BoxAway-v2")
    env = gymnasium.make("WarpDeform/BoxAway-v2")
    assert env.unwrapped.task.version == 2  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("point", "text", "wanted"),
    [
        ("box-away", second(), "'box-away-v2'"),
        ("box-away-v3", second(), "'box-away-v2'"),
        ("box-away-v2", BOX, "'box-away'"),
    ],
)
def test_an_entry_point_of_another_version_is_refused(
    point: str, text: str, wanted: str, tmp_path: Path
) -> None:
    install(tmp_path, "wrong", f"{point} = wrong_tasks:BoxAway", wrong_tasks=text)
    with pytest.raises(InputError, match=f"its entry point must be called {wanted}"):
        find_task("box-away")


def test_a_name_does_not_end_like_a_version(tmp_path: Path) -> None:
    task = box_away(tmp_path)
    task.name = "box-away-v2"
    with pytest.raises(InputError, match="no version behind"):
        warp_deform.register_task(task)
