"""The page's way from nothing to a policy by gradients runs as it stands, in a shorter form."""

from __future__ import annotations

import re
import runpy
import shlex
from pathlib import Path

import pytest
from fixtures.places import ROOT

from warp_deform.command.main import main

PAGE = (ROOT / "docs" / "control.md").read_text()
SECTION = PAGE.split("### From nothing to a policy by gradients\n")[1].split("\n## ")[0]
SHORTER = {
    "--minutes 5": "--updates 2 --snapshots 1 --validate 8 --worlds 8 --episodes 8",
    "eval-control runs/whip": "eval-control runs/whip --episodes 8",
    "updates=20, snapshots=2, validate=32": "updates=2, snapshots=1, validate=8, worlds=8,"
    " episodes=8",
    "episodes=32": "episodes=8",
}


def test_the_page_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text = SECTION
    for long, short in SHORTER.items():
        assert text.count(long) == 1, long
        text = text.replace(long, short)
    monkeypatch.chdir(tmp_path)
    commands = re.findall(r"^    (warp-deform .*)$", text, re.MULTILINE)
    assert len(commands) == 2
    for command in commands:
        assert main(shlex.split(command)[1:]) == 0, command
    said = capsys.readouterr().out
    assert "warp-deform eval-control runs/whip" in said and "of 8 episodes solved" in said
    (code,) = re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    program = tmp_path / "control.py"
    program.write_text(code)
    names = runpy.run_path(str(program))
    away, *left = capsys.readouterr().out.splitlines()
    assert 0 < float(away.removesuffix(" m from the target")) < 1 and left[0].startswith("tensor([")
    assert names["report"]["first_seed"] == 10_000 and names["task"] == "whip-target"
