"""Programs of the page on extending run as they stand, and do what they are there for."""

from __future__ import annotations

import re
import runpy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures.places import ROOT

PAGE = (ROOT / "docs" / "extending.md").read_text()
PROGRAMS = re.findall(r"^```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)


def scene(names: dict[str, Any]) -> None:
    result, beads = names["result"], names["solver"].particle_q(0)
    assert 1.0 <= result.seconds <= 5.0 and result.watch.stretch < 1.1
    # laid over a box of 4 cm, whose top carries the middle
    assert beads[:, 2].max() > 0.04 and beads[:, 2].min() < 0.01


def task(names: dict[str, Any]) -> None:
    assert names["info"]["success"] and names["info"]["score"] == 1.0


def control_task(names: dict[str, Any]) -> None:
    idle = names["problem"].play([0, 1], np.zeros_like(names["found"].numbers))
    assert (names["found"].losses < 1e-3).all() and (idle.scores == 0.0).all()


def arm(names: dict[str, Any]) -> None:
    assert names["result"].q.shape == (3, 7) and names["result"].reached.all()


@pytest.mark.parametrize(
    ("program", "check"), list(zip(PROGRAMS, (scene, task, control_task, arm), strict=True))
)
def test_a_program_runs(
    program: str, check: Callable[[dict[str, Any]], None], tmp_path: Path
) -> None:
    (tmp_path / "program.py").write_text(program)
    check(runpy.run_path(str(tmp_path / "program.py")))
