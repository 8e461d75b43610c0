"""Every example runs as a user would run it; each ends with an assertion of its own.

In the present process, because to import everything anew takes seconds.
"""

import runpy
import sys
from pathlib import Path

import pytest
from fixtures.places import ROOT
from gymnasium.envs import registration

from warp_deform.tasks import registry

EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
ARGUMENTS = {"read_dataset": ["{dataset}", "--sheet", "{out}"]}
"""Arguments of the examples that need any."""


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
    monkeypatch.setattr(registry, "_REGISTERED", {})
    monkeypatch.setattr(registration, "registry", {**registration.registry})
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(example), *arguments])
    runpy.run_path(str(example), run_name="__main__")


def test_examples_are_short() -> None:
    assert len(EXAMPLES) >= 5
    for example in EXAMPLES:
        assert len(example.read_text().splitlines()) <= 80, example.name
