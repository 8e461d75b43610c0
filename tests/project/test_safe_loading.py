"""Nothing that comes from outside may run code: read from the syntax tree of every file."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from fixtures.places import ROOT

FOLDERS = ("warp_deform", "learning", "hardware", "tests", "examples", "benchmarks")
FILES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))
UNSAFE_MODULES = {
    "pickle",
    "_pickle",
    "cPickle",
    "dill",
    "cloudpickle",
    "shelve",
    "marshal",
    "jsonpickle",
}
UNSAFE_CALLS = {
    "joblib.load", "pandas.read_pickle", "yaml.load", "yaml.unsafe_load", "yaml.full_load",
    "yaml.load_all", "os.system", "os.popen",
}  # fmt: skip
UNSAFE_BUILTINS = {"eval", "exec", "__import__"}
ALLOWED = {"learning/interchange/_pickle_process.py": ["line 0: imports pickle"]}
"""The one exception: the locked process that reads the original's recordings, and nothing more."""


def unsafe(source: str) -> list[str]:
    """What in `source` could run code from data, one line each."""
    nodes = list(ast.walk(ast.parse(source)))
    return [f"line {line}: {what}" for line, what in _findings(nodes, _aliases(nodes))]


def _aliases(nodes: list[ast.AST]) -> dict[str, str]:
    """Local name -> full dotted name, for everything imported anywhere in the file."""
    names: dict[str, str] = {}
    for node in nodes:
        if isinstance(node, ast.Import):
            for alias in node.names:
                names[alias.asname or alias.name.split(".")[0]] = (
                    alias.name if alias.asname else alias.name.split(".")[0]
                )
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            for alias in node.names:
                names[alias.asname or alias.name] = f"{node.module}.{alias.name}"
    return names


def _findings(nodes: list[ast.AST], names: dict[str, str]) -> Iterator[tuple[int, str]]:
    for full in names.values():
        if full.split(".")[0] in UNSAFE_MODULES:
            yield 0, f"imports {full}"
    for node in nodes:
        if not isinstance(node, ast.Call):
            continue
        spelled = ast.unparse(node.func)
        head, _, tail = spelled.partition(".")
        full = names.get(head, head) + (f".{tail}" if tail else "")
        keywords = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
        if full in UNSAFE_CALLS or full in UNSAFE_BUILTINS:
            yield node.lineno, f"calls {full}"
        if keywords.get("allow_pickle", "False") != "False":
            yield node.lineno, f"{full} with allow_pickle"
        if full == "torch.load" and keywords.get("weights_only") != "True":
            yield node.lineno, "torch.load without weights_only=True"
        if keywords.get("shell", "False") != "False":
            yield node.lineno, f"{full} with a shell"
        if keywords.get("trust_remote_code", "False") != "False":
            yield node.lineno, f"{full} with trust_remote_code"


def test_files_load_nothing_unsafely() -> None:
    said = {str(path.relative_to(ROOT)): unsafe(path.read_text()) for path in FILES}
    assert {name: lines for name, lines in said.items() if lines} == ALLOWED


def test_the_exception_reads_by_its_own_names_alone() -> None:
    """It subclasses the unpickler, uses nothing else of `pickle`, and nobody imports it."""
    (name,) = ALLOWED
    tree = ast.parse((ROOT / name).read_text())
    used = {ast.unparse(node) for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    assert {text for text in used if text.startswith("pickle.")} == {"pickle.Unpickler"}
    (unpickler,) = (
        node
        for node in tree.body
        if isinstance(node, ast.ClassDef) and "pickle.Unpickler" in map(ast.unparse, node.bases)
    )
    assert {node.name for node in unpickler.body if isinstance(node, ast.FunctionDef)} == {
        "find_class",
        "persistent_load",
    }
    assert "super" not in ast.unparse(unpickler)
    stem = Path(name).stem
    assert [path for path in FILES if re.search(rf"import.*\b{stem}\b", path.read_text())] == []


@pytest.mark.parametrize(
    "source",
    [
        "import pickle",
        "import dill as d",
        "def f():\n    from marshal import loads",
        "import shelve",
        "import numpy as np\nnp.load(f, allow_pickle=True)",
        "import numpy as np\nnp.load(f, allow_pickle=flag)",
        "import torch\ntorch.load(f)",
        "import torch as t\nt.load(f, weights_only=False)",
        "from torch import load as fetch\nfetch(f)",
        "from joblib import load\nload(f)",
        "import yaml\nyaml.load(f, Loader=yaml.Loader)",
        "eval('1')",
        "exec(code)",
        "import os\nos.system('ls')",
        "import subprocess\nsubprocess.run('ls', shell=True)",
    ],
)
def test_an_unsafe_line_is_found(source: str) -> None:
    assert len(unsafe(source)) == 1


@pytest.mark.parametrize(
    "source",
    [
        "model.eval()",
        "import numpy as np\nnp.load(f, allow_pickle=False)",
        "import torch\ntorch.load(f, weights_only=True)",
        "import yaml\nyaml.safe_load(f)",
        "import json\njson.load(f)",
        "import re\nre.compile('x')",
    ],
)
def test_a_safe_line_passes(source: str) -> None:
    assert unsafe(source) == []
