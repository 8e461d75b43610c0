"""Benchmarks that borrow the tests' fixtures start as a user starts them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from fixtures.places import ROOT

BORROWERS = sorted(p for p in (ROOT / "benchmarks").glob("*.py") if "sys.path" in p.read_text())


@pytest.mark.parametrize("script", BORROWERS, ids=lambda path: path.stem)
def test_a_benchmark_starts(script: Path, tmp_path: Path) -> None:
    """The packages are found behind the fixtures, wherever the shell stands."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment["PYTHONSAFEPATH"] = ""
    done = subprocess.run(
        [sys.executable, str(script), "--help"],
        capture_output=True, text=True, cwd=tmp_path, env=environment, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


def test_there_are_some() -> None:
    assert len(BORROWERS) >= 4
