"""The benchmark on the twin counts every episode, also one that never began."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from types import ModuleType, SimpleNamespace

import pytest
from fixtures.franka_arm import Arm
from fixtures.franka_episodes import CALIBRATION, LIMITS, drawn_camera
from fixtures.places import ROOT

from hardware.arm.safe_robot import SafeRobot
from hardware.cameras.camera import CameraError, Frame
from hardware.vision.top_down_view import TopDownView
from warp_deform.xpbd.guards import PhysicsError, Problem, ProblemKind


@pytest.fixture(scope="module")
def twin() -> ModuleType:
    spec = importlib.util.spec_from_file_location("twin_benchmark", ROOT / "benchmarks" / "twin.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


class Blind:
    def read(self) -> Frame:
        raise CameraError("no picture")


@contextlib.contextmanager
def bad_toss(config: object) -> Iterator[None]:
    raise PhysicsError((Problem(ProblemKind.STRETCH, 0, 2.1, 2.0),))
    yield


@contextlib.contextmanager
def blind(config: object) -> Iterator[SimpleNamespace]:
    robot = SafeRobot(Arm(), LIMITS)
    yield SimpleNamespace(
        robot=robot,
        camera=Blind(),
        calibration=CALIBRATION,
        view=TopDownView(),
        look=None,
        toss=None,
    )


@pytest.mark.parametrize("rig", [bad_toss, blind])
def test_an_episode_without_a_picture_is_a_failed_one(
    twin: ModuleType, monkeypatch: pytest.MonkeyPatch, rig: object
) -> None:
    monkeypatch.setattr(twin, "open_rig", rig)
    played = twin.play("random", 0, 0)
    assert not played.success and played.actions == 10
    assert (played.outcomes, played.overlaps) == ((), (0.0,))
    assert "| random | 0 / 1 |" in twin._line("random", [played])


def test_an_episode_is_played(twin: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    @contextlib.contextmanager
    def drawn(config: object) -> Iterator[SimpleNamespace]:
        with blind(config) as rig, drawn_camera(lambda: 0.45) as camera:
            rig.camera = camera
            yield rig

    monkeypatch.setattr(twin, "open_rig", drawn)
    monkeypatch.setattr(twin, "run_episode", _short(twin.run_episode))
    played = twin.play("random", 0, 0)
    assert played.actions == len(played.outcomes) == len(played.overlaps) - 1 == 1


def _short(run_episode: object) -> object:
    from hardware.episodes.episode import EpisodeConfig

    return lambda *a, **k: run_episode(*a, **k, config=EpisodeConfig(max_actions=1))


def test_mean_actions_are_of_all_and_of_the_solved(twin: ModuleType) -> None:
    solved = twin.Played("a", 0, 0, True, 4, (), (0.0, 0.3), 2.0)
    failed = replace(solved, goal=1, success=False, actions=10, overlaps=(0.0, 0.1))
    line = twin._line("a", [solved, failed])
    assert "| 1 / 2 |" in line and "| 7.00 ± 38.12 | 4.00 | 0.20 | 0.3 |" in line
    assert "| 0 / 1 | - | 10.00 | - |" in twin._line("a", [failed])


def test_tosses_of_one_goal_are_no_further_goals(twin: ModuleType) -> None:
    """Ten goals, six of them solved at every toss: about as sure as six of ten."""
    one = twin.Played("a", 0, 0, True, 4, (), (0.0, 0.3), 2.0)
    rows = [
        replace(one, goal=goal, toss=toss, success=goal < 6)
        for goal in range(10)
        for toss in range(10)
    ]
    assert "| 60 / 100 | 27.1 to 85.8 |" in twin._line("a", rows)


@pytest.mark.parametrize(
    ("file", "agent", "documented"),
    [
        ("twin.jsonl", "planner", "| `planner`, no demonstrations |"),
        ("twin.jsonl", "policy", "| `policy`, Goal-Split, 500 demonstrations |"),
        ("twin_goal_stack.jsonl", "policy", "| `policy`, Goal-Stack, 100 demonstrations |"),
        (
            "twin_paper_protocol.jsonl",
            "policy",
            "| `policy`, Goal-Split, 24 + 6 demonstrations, one",
        ),
        ("twin_traced.jsonl", "policy", "| `policy`, traced, 1000 demonstrations |"),
        ("twin_traced_24.jsonl", "policy", "| `policy`, traced from 24 + 6 demonstrations |"),
        ("twin.jsonl", "scripted", "| `scripted`, which knows the chain |"),
        ("twin.jsonl", "random", "| `random` | 0 |"),
    ],
)
def test_the_documented_means_are_those_of_the_rows(
    twin: ModuleType, file: str, agent: str, documented: str
) -> None:
    lines = (ROOT / "benchmarks" / "results" / file).read_text().splitlines()
    rows = [twin.Played(**json.loads(line)) for line in lines]
    cells = twin._line(agent, [row for row in rows if row.agent == agent]).split("|")
    table = (ROOT / "docs" / "hardware.md").read_text().splitlines()
    (line,) = [line for line in table if line.startswith(documented)]
    assert f"|{cells[3]}|{cells[4]}|{cells[5]}|" in line
