"""The benchmark that plays two source trees in turns, on trees that cost what is said."""

import subprocess
import sys
from pathlib import Path

import pytest
from fixtures.places import ROOT

sys.path.insert(0, str(ROOT / "benchmarks"))

import commits

PACKAGE = """
def run(scene):
    cloth.time_worlds(scene, lambda worlds, lanes: worlds, play)
    return {}


def play(worlds, seeds):
    print("not an answer")
    assert worlds == len(seeds)
    moving, rest = COST
    parts = dict(cpu=moving * len(seeds), seconds=2.0, rest_cpu=rest * len(seeds), rest_seconds=4.0)
    return types.SimpleNamespace(**parts)
"""


def tree(folder: Path, moving: float, rest: float) -> Path:
    """A source tree whose scenes cost so many CPU seconds a play and world."""
    bench = folder / "warp_deform" / "bench"
    bench.mkdir(parents=True)
    for module in ("bag", "cloth", "rigid"):
        (bench / f"{module}.py").touch()
    head = f"import types\n\nfrom . import cloth\n\nCOST = {moving}, {rest}\n"
    (bench / "__init__.py").write_text(head + PACKAGE)
    (folder / "warp_deform" / "__init__.py").touch()
    (folder / "warp_deform" / "quiet.py").write_text("def quiet_warp():\n    pass\n")
    return folder


def test_ratios_are_of_the_newer_over_the_older(tmp_path: Path) -> None:
    older, newer = tree(tmp_path / "a", 0.2, 0.4), tree(tmp_path / "b", 0.3, 0.2)
    rows = commits.compare(older, newer, "cloth10", rounds=3)
    assert [(row["how"], row["part"]) for row in rows] == [
        (how, part) for how in ("alone", "lanes") for part in ("play", "rest")
    ]
    for row in rows:
        before, after = {"play": (100.0, 150.0), "rest": (100.0, 50.0)}[row["part"]]
        assert row["older_ms"] == pytest.approx(before) and row["newer_ms"] == pytest.approx(after)
        assert row["ratio"] == row["ratio_of_lowest"] == pytest.approx(after / before)
        assert row["ratio_quartiles"] == pytest.approx([after / before] * 2)


def test_a_tree_that_fails_ends_the_comparison(tmp_path: Path) -> None:
    older, newer = tree(tmp_path / "a", 0.2, 0.4), tree(tmp_path / "b", 0.3, 0.2)
    (newer / "warp_deform" / "quiet.py").write_text("raise ImportError\n")
    with pytest.raises(SystemExit, match="code 1"):
        commits.compare(older, newer, "cloth10", rounds=1)


def test_a_worker_that_has_ended_is_told_by_its_code() -> None:
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", "exit(3)"], **pipes) as worker:
        worker.wait()
        with pytest.raises(SystemExit, match="code 3"):
            commits._ask(worker, "alone", 0)
        worker.stdin = None  # what waits in it can no longer be sent


def test_another_package_than_the_tree_s_is_refused(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    older, newer = tree(tmp_path / "a", 0.2, 0.4), tmp_path / "b"
    (newer / "warp_deform" / "bench").mkdir(parents=True)
    (newer / "warp_deform" / "__init__.py").write_text(
        f"__path__ = [{str(older / 'warp_deform')!r}]\n"
    )
    with pytest.raises(SystemExit, match="code 1"):
        commits.compare(older, newer, "cloth10", rounds=1)
    assert "was imported, not what" in capfd.readouterr().err


@pytest.mark.parametrize("words", [["."], ["nowhere"], ["--rounds", "0"]])
def test_what_cannot_be_compared_is_refused(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    older = tree(tmp_path / "a", 0.2, 0.4)
    places = [str(older), str(older)] if "--rounds" in words else [str(older)]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["commits.py", *places, *words])
    with pytest.raises(SystemExit) as ended:
        commits.main()
    assert ended.value.code == 2
    assert capsys.readouterr().err.count("error:") == 1
