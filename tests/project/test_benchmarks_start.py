"""Benchmarks that borrow the tests' fixtures start as a user starts them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from fixtures.places import ROOT

BORROWERS = sorted(p for p in (ROOT / "benchmarks").glob("*.py") if "sys.path" in p.read_text())
START_ALL = """
import contextlib, io, json, runpy, site, sys, traceback
from pathlib import Path

# each script begins with the path of a process of its own, and loads anew what is no library
folders = [*site.getsitepackages(), sys.base_prefix]
libraries = tuple(str(Path(folder).resolve()) for folder in folders)
path, said = sys.path[1:], {}
for script in sys.argv[1:]:
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)
        if name != "__main__" and file and not str(Path(file).resolve()).startswith(libraries):
            del sys.modules[name]
    sys.path[:], sys.argv[:] = [str(Path(script).parent), *path], [script, "--help"]
    out = io.StringIO()
    try:
        with contextlib.redirect_stdout(out):
            runpy.run_path(script, run_name="__main__")
        said[script] = "ended"
    except SystemExit as done:
        said[script] = done.code or out.getvalue()[:6]
    except BaseException:
        said[script] = traceback.format_exc()
print(json.dumps(said))
"""
"""One process for all: to import torch and a simulator anew takes seconds."""


def start_all(scripts: list[Path], folder: Path) -> dict[str, str | int]:
    """How each script's help begins, or what became of it instead; started in `folder`."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment["PYTHONSAFEPATH"] = ""
    done = subprocess.run(
        [sys.executable, "-c", START_ALL, *map(str, scripts)],
        capture_output=True, text=True, cwd=folder, env=environment, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    said: dict[str, str | int] = json.loads(done.stdout.splitlines()[-1])
    return {Path(script).name: text for script, text in said.items()}


def test_benchmarks_start(tmp_path: Path) -> None:
    """The packages are found behind the fixtures, wherever the shell stands."""
    said = start_all(BORROWERS, tmp_path)
    assert said.pop("peers_measures.py") == "ended", "others import it"
    assert said == {path.name: "usage:" for path in BORROWERS if path.name in said}
    assert len(said) == len(BORROWERS) - 1 >= 4


def test_a_benchmark_that_finds_no_fixtures_is_found(tmp_path: Path) -> None:
    """Behind one that does: what that one put on the path, and loaded, is no help to it."""
    add = f"import sys\nsys.path.insert(0, {str(ROOT / 'tests' / 'shared')!r})\n"
    works = "import fixtures.places, argparse\nargparse.ArgumentParser().parse_args()\n"
    (tmp_path / "good.py").write_text(add + works)
    (tmp_path / "bad.py").write_text(works)
    (tmp_path / "fails.py").write_text("raise SystemExit(3)\n")
    said = start_all([tmp_path / f"{name}.py" for name in ("good", "bad", "fails")], tmp_path)
    assert said["good.py"] == "usage:" and said["fails.py"] == 3
    assert "No module named 'fixtures'" in str(said["bad.py"])
