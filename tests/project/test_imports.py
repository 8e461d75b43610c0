"""Importing is quick and loads nothing heavy; what is public exists and is documented."""

from __future__ import annotations

import ast
import importlib
import inspect
import json
import subprocess
import sys
from pathlib import Path

import gymnasium
import pytest
from fixtures.places import ROOT

import warp_deform
from warp_deform.tasks.registration import env_id, register_environments
from warp_deform.tasks.registry import TASKS

RE_EXPORT = {"warp_deform", "hardware", "warp_deform.solver"}
MODULES = sorted(
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    for package in ("warp_deform", "learning", "hardware")
    for path in (ROOT / package).rglob("*.py")
    if path.name != "__main__.py" and "assets" not in path.parts
)
MEASURE = """
import json, sys, time
start = time.process_time()
import warp_deform, learning, hardware
imported = time.process_time() - start
heavy = sorted({"torch", "warp", "newton", "scipy"} & set(sys.modules))
from warp_deform.command.main import main
code = main(["list", "--json"])
listed = time.process_time() - start
print(json.dumps({"imported": imported, "listed": listed, "heavy": heavy, "code": code,
                  "heavy_list": sorted({"torch", "newton", "scipy"} & set(sys.modules))}))
"""


@pytest.fixture(scope="module")
def fresh() -> dict[str, object]:
    """A new process that imports the packages and lists the tasks; times are the process's [s]."""
    done = subprocess.run(
        [sys.executable, "-c", MEASURE], capture_output=True, text=True, cwd=ROOT, check=True
    )
    listing, measured = done.stdout.splitlines()
    return {**json.loads(measured), "tasks": json.loads(listing)["tasks"]}


def test_import_is_quick_and_light(fresh: dict[str, float]) -> None:
    assert fresh["heavy"] == []
    assert fresh["imported"] < 1.5


def test_list_answers_without_torch_or_newton(fresh: dict[str, float]) -> None:
    assert fresh["code"] == 0
    assert fresh["heavy_list"] == []
    assert fresh["listed"] < 1.5


def test_public_names_exist_documented_and_typed() -> None:
    undocumented, untyped = [], []
    for module in map(importlib.import_module, MODULES):
        undocumented += [] if module.__doc__ else [module.__name__]
        for public in getattr(module, "__all__", ()):
            value, name = getattr(module, public), f"{module.__name__}.{public}"
            if inspect.isclass(value) or inspect.isfunction(value):
                # A dataclass without a docstring gets its signature as one.
                said = value.__doc__ and not value.__doc__.startswith(f"{public}(")
                undocumented += [] if said else [name]
            if inspect.isfunction(value):
                annotated = set(value.__annotations__)
                typed = {"return", *inspect.signature(value).parameters} == annotated
                untyped += [] if typed else [name]
    assert (undocumented, untyped) == ([], [])
    assert len(MODULES) > 500


def test_modules_say_what_is_public() -> None:
    """In their own `__all__`, or in that of the package that hands it on."""
    silent = []
    for name in MODULES:
        module = importlib.import_module(name)
        body = ast.parse(Path(str(module.__file__)).read_text()).body
        defined = {node.name for node in body if isinstance(node, ast.FunctionDef | ast.ClassDef)}
        defined |= {target for node in body for target in _targets(node)}
        public = {each for each in defined if not each.startswith("_")}
        if public and not name.rpartition(".")[2].startswith("_"):
            package = importlib.import_module(name.rpartition(".")[0])
            handed_on = {*getattr(module, "__all__", ()), *getattr(package, "__all__", ())}
            silent += [] if public & handed_on else [name]
    assert silent == []


def _targets(node: ast.stmt) -> list[str]:
    """Names that a statement assigns to."""
    targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
    return [target.id for target in targets if isinstance(target, ast.Name)]


def test_a_public_name_has_one_import_path() -> None:
    """What the packages of `RE_EXPORT` re-export from below is the one exception."""
    listed: dict[tuple[str, str], list[str]] = {}
    for name in MODULES:
        module = importlib.import_module(name)
        for public in getattr(module, "__all__", ()) if name not in RE_EXPORT else ():
            value = getattr(module, public)
            if inspect.isclass(value) or inspect.isfunction(value):
                listed.setdefault((value.__module__, value.__qualname__), []).append(name)
    assert {key: names for key, names in listed.items() if len(names) > 1} == {}


def test_warp_starts_without_a_word() -> None:
    script = "from warp_deform.quiet import quiet_warp; quiet_warp(); import warp; warp.init()"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, cwd=ROOT, check=True
    )
    assert (done.stdout, done.stderr) == ("", "")


def test_results_are_read_without_a_simulator() -> None:
    """`warp-deform report` then starts in half of the time."""
    script = "import learning.report.report, sys; print({'newton', 'warp'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=ROOT)
    assert (done.stdout, done.stderr) == ("set()\n", "")


def test_lazy_names() -> None:
    assert set(warp_deform.__all__) <= set(dir(warp_deform))
    with pytest.raises(AttributeError, match="no attribute 'cables'"):
        warp_deform.__getattr__("cables")


def test_every_task_has_a_gymnasium_id() -> None:
    assert {name: task.name for name, task in TASKS.items()} == {name: name for name in TASKS}
    register_environments()  # again: changes nothing, warns of nothing
    for name in TASKS:
        assert gymnasium.spec(env_id(name)).kwargs == {"task": name}


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("cable-ring", "WarpDeform/CableRing-v3"),
        ("cable-ring-notarget", "WarpDeform/CableRingNotarget-v3"),
        ("bag-items-1", "WarpDeform/BagItems1-v6"),
    ],
)
def test_gymnasium_id(name: str, expected: str) -> None:
    assert env_id(name) == expected
