"""Every example runs as a user would run it; each ends with an assertion of its own."""

import os
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
from fixtures.places import ROOT

EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
ARGUMENTS = {"read_dataset": ["{dataset}", "--sheet", "{out}"]}
"""Arguments of the examples that need any."""
IN_A_PROCESS = {"own_task", "vector_env"}
"""Those that register a task or start processes; to import everything anew takes seconds."""


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from warp_deform.collecting.collect import CollectConfig, collect

    folder = tmp_path_factory.mktemp("examples") / "block"
    collect(CollectConfig(task="block-notarget", episodes=2, seed=0, out=folder, workers=1))
    return folder


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_example_runs(
    example: Path, dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    places = {"dataset": str(dataset), "out": str(tmp_path / "out.png")}
    arguments = [word.format(**places) for word in ARGUMENTS.get(example.stem, [])]
    if example.stem not in IN_A_PROCESS:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", [str(example), *arguments])
        runpy.run_path(str(example), run_name="__main__")
        return
    done = subprocess.run(
        [sys.executable, str(example), *arguments],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=240,
    )
    assert done.returncode == 0, done.stderr[-2000:]


def test_examples_are_short() -> None:
    assert len(EXAMPLES) >= 5
    for example in EXAMPLES:
        assert len(example.read_text().splitlines()) <= 80, example.name
