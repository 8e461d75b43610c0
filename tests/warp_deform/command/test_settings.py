"""A verb's flags, its configuration and its help are one dataclass, which loads quickly."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import fields
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pytest
from fixtures.places import ROOT

from hardware.command.franka import RunOptions
from hardware.rig.config import RigConfig
from learning.command import correct, distill, refine, verbs
from learning.correction.correct import CorrectConfig
from learning.distillation.distill import DistillConfig
from learning.evaluation import run as evaluation
from learning.evaluation.settings import EvalSettings
from learning.policy.policy import AGENTS
from learning.refinement import waypoints
from learning.refinement.refine import ACCEPT, RefineConfig
from learning.refinement.settings import RefineSettings, TrajectorySettings
from learning.training import train as training
from learning.training.config import TrainConfig
from learning.training.processes import DEVICES
from learning.training.schedules import SCHEDULES
from learning.training.settings import AgentName, PresetName, TrainSettings
from warp_deform.collecting.collect import CollectConfig
from warp_deform.collecting.settings import CollectSettings, DemonstratorName
from warp_deform.command import main as cli
from warp_deform.command import verbs as own_verbs
from warp_deform.command.main import CommandOptions, main
from warp_deform.control import METHODS as CONTROL_METHODS
from warp_deform.errors import InputError
from warp_deform.gradcheck import GradcheckConfig
from warp_deform.planning import METHODS, SearchConfig
from warp_deform.planning.demonstrators import DEMONSTRATORS

REFINEMENTS = {**dict.fromkeys(METHODS), **CONTROL_METHODS}
COMMAND = {each.name for each in fields(CommandOptions)}
LINE = "cable-line-notarget"
TRAIN = ["train", LINE, "--agent", "gt-mlp-2step", "--data", "d", "--out", "r"]
CHANGED: dict[str, tuple[list[str], Any]] = {
    "demos": (["3"], 3),
    "seed": (["5"], 5),
    "preset": (["fast"], "fast"),
    "steps": (["40"], 40),
    "batch": (["2"], 2),
    "lr": (["0.5"], 0.5),
    "snapshots": (["4"], 4),
    "validate": (["7"], 7),
    "confirm": (["9"], 9),
    "patience": (["6"], 6),
    "goal": (["own"], "own"),
    "precision": (["float32"], "float32"),
    "device": (["cuda"], "cuda"),
    "untrained": ([], True),
    "no_augment": ([], True),
    "exact": ([], True),
    "hold_out": (["8"], 8),
    "start": (["before"], Path("before")),
    "threads": (["9"], 9),
    "tensorboard": ([], True),
}
"""By setting of `train`, the words behind its flag and the value that they mean."""


@pytest.mark.parametrize(
    ("options", "config"),
    [
        (verbs.TrainOptions, TrainConfig),
        (RunOptions, RigConfig),
        (verbs.EvalOptions, EvalSettings),
        (refine.RefineOptions, RefineConfig),
        (correct.CorrectOptions, CorrectConfig),
        (distill.DistillOptions, DistillConfig),
        (own_verbs.DemoOptions, CollectConfig),
        (own_verbs.GradcheckOptions, GradcheckConfig),
    ],
    ids=lambda kind: kind.__name__,
)
def test_what_options_and_configuration_share_is_written_once(
    options: type[CommandOptions], config: type[Any]
) -> None:
    shared = {each.name for each in fields(options)} & {each.name for each in fields(config)}
    common = set(options.__mro__) & set(config.__mro__)
    written = {name for kind in common for name in vars(kind).get("__annotations__", {})}
    assert shared and shared == written & shared
    assert not shared & set(vars(options).get("__annotations__", {}))
    said = [get_type_hints(kind, include_extras=True) for kind in (options, config)]
    assert all(said[0][name] == said[1][name] for name in shared)


@pytest.mark.parametrize(
    ("choices", "table"),
    [
        (AgentName, AGENTS),
        (PresetName, SCHEDULES),
        (DemonstratorName, DEMONSTRATORS),
        (get_type_hints(TrainSettings)["device"], DEVICES),
        (get_type_hints(RefineSettings)["accept"], ACCEPT),
        (get_type_hints(refine.RefineOptions)["method"], REFINEMENTS),
        (get_type_hints(TrajectorySettings)["method"], CONTROL_METHODS),
        (get_args(get_type_hints(GradcheckConfig)["levels"])[0], GradcheckConfig().levels),
    ],
)
def test_choices_of_a_flag_are_those_that_there_are(choices: Any, table: Any) -> None:
    assert list(get_args(choices)) == list(table)


@pytest.mark.parametrize("name", CHANGED)
def test_a_flag_of_train_changes_its_setting_alone(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    words, value = CHANGED[name]
    agent = ["--agent", "transporter"] if name == "precision" else []
    others = ["--validate", "1"] if name in ("confirm", "patience") else []
    seen: list[TrainConfig] = []

    def record(config: TrainConfig) -> None:
        seen.append(config)
        raise KeyboardInterrupt

    monkeypatch.setattr(training, "train", record)
    monkeypatch.setattr(verbs, "find_task", lambda name: name)
    flag = name.replace("_", "-")
    plain = [*TRAIN, *agent, *others]
    for line in (plain, [*plain, f"--{flag}", *words]):
        assert main(line) in (2, 130)
    before, after = ({f.name: getattr(each, f.name) for f in fields(each)} for each in seen)
    setting, meant = ("augment", False) if name == "no_augment" else (name, value)
    assert after == {**before, setting: meant} and before[setting] != meant


def test_the_flags_of_train_are_all_tried() -> None:
    needed = {"task", "agent", "data", "out"}
    assert {each.name for each in fields(verbs.TrainOptions)} == needed | COMMAND | CHANGED.keys()


def test_search_and_folder_settings_reach_a_refinement() -> None:
    line = ["a", "--out", "b", "--method", "random", "--depth", "1", "--budget", "9", "--lifts"]
    options = cli._parse("refine", refine.refine, [*line, "--accept", "solved", "--workers", "3"])
    assert isinstance(options, refine.RefineOptions)
    assert options.configure(SearchConfig) == SearchConfig(
        method="random", depth=1, budget=9, lifts=True
    )
    assert options.configure(RefineConfig) == RefineConfig(
        source=Path("a"), out=Path("b"), accept="solved", workers=3
    )


@pytest.mark.parametrize("retry", [True, False])
def test_what_eval_is_told_reaches_the_evaluation(
    retry: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: dict[str, Any] = {}

    def record(path: Path, **settings: Any) -> None:
        seen.update(settings, path=path)
        raise KeyboardInterrupt

    monkeypatch.setattr(evaluation, "evaluate_run", record)
    line = ["eval", "run", "--robot", "panda", "--episodes", "3", "--stage-rule", "privileged"]
    assert main([*line, *(() if retry else ("--no-retry",))]) == 130
    assert seen["path"] == Path("run") and seen["retry"] is retry
    assert (seen["robot"], seen["episodes"]) == ("panda", 3)
    assert (seen["stage_rule"], seen["validation_episodes"]) == ("privileged", 20)


def test_a_task_is_looked_up_when_its_module_is_loaded() -> None:
    """So options are not checked as a configuration is: their task may not be known yet."""
    options = cli._parse("demo", own_verbs.demo, ["my-own-task", "--out", "d"])
    assert isinstance(options, CollectSettings) and options.task == "my-own-task"


@pytest.mark.parametrize(
    "line", ["train --help", "eval --help", "sweep --help", "demo --help", "refine --help",
             "gradcheck --help", "franka run --help", "franka calibrate --help",
             "franka calibrate hand --help"],
)  # fmt: skip
def test_help_loads_neither_torch_nor_a_simulator(line: str) -> None:
    script = (
        "import sys\nfrom warp_deform.command.main import main\n"
        f"code = main({line.split()})\n"
        "print(sorted({'torch', 'warp', 'newton'} & set(sys.modules)), file=sys.stderr)\n"
        "sys.exit(code)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=ROOT)
    assert (done.returncode, done.stderr) == (0, "[]\n")
    assert f"warp-deform {line.removesuffix(' --help')}" in done.stdout


@pytest.mark.parametrize(
    ("further", "raised"),
    [
        ({}, KeyboardInterrupt),
        ({"workers": 2, "json": True, "task_module": "mine"}, KeyboardInterrupt),
        ({"lifts": True}, InputError),
        ({"accept": "solved"}, InputError),
        ({"depth": 1}, InputError),
    ],
)
def test_paths_are_bent_with_the_flags_of_every_verb_and_folder(
    further: dict[str, Any], raised: type[BaseException], monkeypatch: pytest.MonkeyPatch
) -> None:
    def record(config: waypoints.BendConfig) -> None:
        assert (config.source, config.workers) == (Path("a"), further.get("workers"))
        raise KeyboardInterrupt

    monkeypatch.setattr(waypoints, "bend", record)
    options = refine.RefineOptions(
        source=Path("a"), out=Path("b"), budget=20, waypoints=True, **further
    )
    with pytest.raises(raised):
        refine.refine(options)
