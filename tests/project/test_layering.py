"""The direction of imports, read from every file: hardware -> warp_deform <- learning.

Within a package the rooms (folders, and files beside them) stand on floors: what is imported stands
below, and no two files know each other, however many lie between them.

One named exception: hardware may load `learning.policy` inside a function. The command's table
names verbs as "module:function" strings, which stand outside this rule because nothing is imported
until a verb is called.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from typing import NamedTuple

import pytest
from fixtures.places import ROOT

from warp_deform.command.main import VERBS

MAY_IMPORT = {
    "warp_deform": {"warp_deform"},
    "learning": {"learning", "warp_deform"},
    "hardware": {"hardware", "warp_deform"},
}
OURS = {*MAY_IMPORT, "tests", "examples", "benchmarks"}
LAZY_EXCEPTION = ("hardware", "learning.policy")
FLOORS = {
    "warp_deform": [
        "__main__",
        "command envs",
        "page",
        "gradcheck collecting",
        "control",
        "planning",
        "worlds bench",
        "tasks",
        "robots solver",
        "rollout",
        "rendering xpbd peers",
        "objects",
        "quiet episodes",
        "support",
        "errors",
    ],
    "learning": [
        "command",
        "page",
        "sweep distillation",
        "report control",
        "training correction",
        "evaluation",
        "policy",
        "data",
        "models runs refinement interchange",
    ],
    "hardware": [
        "command",
        "measuring page",
        "choosers",
        "rig episodes",
        "twin recordings",
        "calibration",
        "vision backends emulator",
        "arm cameras",
        "support",
    ],
}
"""Rooms from top to bottom; those of one floor do not know each other."""
OPTIONAL = {
    "pybullet", "pybullet_data", "cmaes", "ray", "tensorboard", "h5py", "panda_py",
    "franky", "frankapy", "pyk4a", "pyrealsense2", "websockets", "playwright",
}  # fmt: skip
COMPUTED_IMPORTS = {
    "warp_deform/command/main.py",
    "warp_deform/support/lazy_exports.py",
    "warp_deform/tasks/external.py",
}
ADDS_TO_PATH = {"warp_deform/tasks/external.py"}
"""Where a user's own module is looked for."""
FILES = sorted(path for package in MAY_IMPORT for path in (ROOT / package).rglob("*.py"))


class Import(NamedTuple):
    module: str
    line: int
    lazy: bool


@cache
def imports(source: str, module: str, *, is_package: bool) -> list[Import]:
    """Every import of `source`, relative ones resolved against its own dotted name `module`."""
    package = module.split(".") if is_package else module.split(".")[:-1]

    def visit(node: ast.AST, lazy: bool) -> Iterator[Import]:
        if isinstance(node, ast.expr):  # holds no statement
            return
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            lazy = True
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            lazy = True
        if isinstance(node, ast.Import):
            yield from (Import(alias.name, node.lineno, lazy) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            assert not node.level or base, (
                f"{module}:{node.lineno}: import climbs out of the package"
            )
            origin = ".".join([*base, *([node.module] if node.module else [])])
            # `from learning import policy` names a module as much as `import learning.policy` does.
            yield from (Import(f"{origin}.{name.name}", node.lineno, lazy) for name in node.names)
        for child in ast.iter_child_nodes(node):
            yield from visit(child, lazy)

    return list(visit(ast.parse(source), False))


def violations(source: str, module: str, *, is_package: bool = False) -> list[str]:
    own = module.split(".")[0]
    wrong = []
    for item in imports(source, module, is_package=is_package):
        top = item.module.split(".")[0]
        excused = (
            item.lazy and own == LAZY_EXCEPTION[0] and item.module.startswith(LAZY_EXCEPTION[1])
        )
        if top in OURS - MAY_IMPORT[own] and not excused:
            wrong.append(f"{module}:{item.line} imports {item.module}")
        if top in OPTIONAL and not item.lazy:
            wrong.append(f"{module}:{item.line} imports optional {item.module} at the top")
    return wrong


def test_imports_point_one_way() -> None:
    wrong = []
    for path in FILES:
        dotted = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        wrong += violations(path.read_text(), dotted, is_package=path.name == "__init__.py")
    assert wrong == []


def test_no_import_hides() -> None:
    """A module's name that is computed at run time would hide from the test above."""

    def computes(source: str) -> bool:
        calls = (node.func for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call))
        names = {getattr(func, "attr", getattr(func, "id", None)) for func in calls}
        return bool({"import_module", "__import__"} & names)

    sources = {str(path.relative_to(ROOT)): path.read_text() for path in FILES}
    assert {name for name, source in sources.items() if computes(source)} == COMPUTED_IMPORTS
    assert {name for name, source in sources.items() if "sys.path." in source} == ADDS_TO_PATH


def block_wrong(source: str) -> bool:
    """Whether imports for annotations alone stand in several blocks, or before other imports."""
    body = ast.parse(source).body
    blocks = [
        at
        for at, node in enumerate(body)
        if isinstance(node, ast.If)
        and ast.unparse(node.test) == "TYPE_CHECKING"
        and isinstance(node.body[0], ast.Import | ast.ImportFrom)
    ]
    return len(blocks) > 1 or any(
        isinstance(node, ast.Import | ast.ImportFrom) for at in blocks for node in body[at:]
    )


def test_imports_for_annotations_alone_stand_last_in_one_block() -> None:
    assert [path for path in FILES if block_wrong(path.read_text())] == []
    assert block_wrong("if TYPE_CHECKING:\n    import a\nimport b\n")


@cache
def modules(package: str) -> dict[str, set[str]]:
    """By dotted name, the modules of `package` that each of them imports, lazily or not."""
    paths = {}
    for path in FILES:
        parts = path.relative_to(ROOT).with_suffix("").parts
        if parts[0] == package:
            paths[".".join(parts).removesuffix(".__init__")] = path
    arrows: dict[str, set[str]] = {}
    for name, path in paths.items():
        every = imports(path.read_text(), name, is_package=path.name == "__init__.py")
        # `from .b import c` names the module a.b.c where there is one, else a.b
        named = {
            item.module if item.module in paths else item.module.rpartition(".")[0]
            for item in every
        }
        arrows[name] = named & paths.keys()
    return arrows


def room(module: str) -> str:
    """The folder, or the file, that a module of a package stands in; empty for the package."""
    return module.split(".")[1] if "." in module else ""


def upward(arrows: dict[str, set[str]], floors: list[str]) -> list[str]:
    """Imports that do not go down."""
    level = {name: k for k, names in enumerate(floors) for name in names.split()}
    return [
        f"{module} imports {other}"
        for module, others in sorted(arrows.items())
        for other in sorted(others)
        if room(module)
        and room(module) != room(other)
        and (not room(other) or level[room(module)] >= level[room(other)])
    ]


def circle(arrows: dict[str, set[str]]) -> list[str]:
    """Modules of which each imports the next, and the last the first; none where there are none."""
    left = {name: set(others) - {name} for name, others in arrows.items()}
    while True:
        ends = {name for name, others in left.items() if not others & left.keys()}
        if not ends:
            break
        left = {name: others for name, others in left.items() if name not in ends}
    trail: list[str] = []
    step = min(left, default=None)
    while step is not None and step not in trail:
        trail.append(step)
        step = min(left[step] & left.keys())
    return trail[trail.index(step) :] if step is not None else []


@pytest.mark.parametrize("package", FLOORS)
def test_rooms_stand_on_floors(package: str) -> None:
    arrows = modules(package)
    named = [name for floor in FLOORS[package] for name in floor.split()]
    assert sorted(named) == sorted({room(name) for name in arrows} - {""})
    assert upward(arrows, FLOORS[package]) == []


@pytest.mark.parametrize("package", FLOORS)
def test_no_files_import_each_other(package: str) -> None:
    assert circle(modules(package)) == []


def test_a_circle_and_an_upward_import_are_found() -> None:
    arrows = {"p.a.x": {"p.b.y"}, "p.b.y": {"p.c"}, "p.c": {"p.b.y", "p.d"}, "p.d": set()}
    assert circle(arrows) == ["p.b.y", "p.c"]
    assert circle({"p.a": {"p.b"}, "p.b": set()}) == []
    assert upward(arrows, ["a", "b", "c", "d"]) == ["p.c imports p.b.y"]
    assert upward(arrows, ["a", "b c", "d"]) == ["p.b.y imports p.c", "p.c imports p.b.y"]
    assert upward({"p.a": {"p"}, "p": set()}, ["a"]) == ["p.a imports p"]


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("warp_deform.envs.env", "import learning"),
        ("warp_deform.envs.env", "def f():\n    from learning.policy import load"),
        ("warp_deform.envs.env", "from hardware import safety"),
        ("learning.policy", "import hardware.arm.safe_robot"),
        ("hardware.episodes.episode", "from learning.policy import load"),
        ("hardware.episodes.episode", "def f():\n    import learning.training"),
        ("hardware.backends.panda", "import panda_py"),
        ("warp_deform.envs.env", "import tests.test_cli"),
    ],
)
def test_a_wrong_import_is_found(module: str, source: str) -> None:
    assert len(violations(source, module)) == 1


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("warp_deform.tasks.task", "from ..objects import cable"),
        ("learning.policy", "from warp_deform.episodes import Episode"),
        ("hardware.episodes.episode", "def f():\n    from learning.policy import load"),
        ("hardware.backends.panda", "def connect():\n    import panda_py"),
    ],
)
def test_a_right_import_passes(module: str, source: str) -> None:
    assert violations(source, module) == []


def test_an_import_cannot_climb_out() -> None:
    with pytest.raises(AssertionError, match="climbs out"):
        imports("from ...learning import policy", "warp_deform.tasks.task", is_package=False)


@pytest.mark.parametrize("name", VERBS)
def test_a_verb_names_a_function_that_exists(name: str) -> None:
    module, function = VERBS[name].target.split(":")
    base = ROOT.joinpath(*module.split("."))
    path = base / "__init__.py" if base.is_dir() else base.with_suffix(".py")
    defined = [
        node for node in ast.parse(path.read_text()).body if isinstance(node, ast.FunctionDef)
    ]
    verb = next(node for node in defined if node.name == function)
    assert len(verb.args.args) == 1
    assert verb.args.args[0].annotation is not None
