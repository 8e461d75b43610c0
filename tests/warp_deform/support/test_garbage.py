"""Garbage is looked for among the young only, and not when a process ends."""

from __future__ import annotations

import subprocess
import sys

import pytest
from fixtures.places import ROOT

SCRIPT = """
import atexit, gc

class Loop:
    def __init__(self):
        self.itself = self
    def __del__(self):
        gone.append(self)

gone = []
atexit.register(lambda: print(gc.get_freeze_count() > 1000))
before = gc.get_threshold()
{}
after = gc.get_threshold()
Loop()
[[] for _ in range(before[0])]
keep = [[] for _ in range(2 * before[0])]
print(after[:2] == before[:2], after[2] > before[2], len(gone))
"""


@pytest.mark.parametrize(
    ("call", "said"),
    [
        ("import warp_deform.support.garbage as g; g.collect_rarely()", "True 1\nTrue"),
        ("", "False 1\nFalse"),
    ],
)
def test_the_young_are_looked_through_as_before(call: str, said: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT.format(call)], capture_output=True, text=True, cwd=ROOT
    )
    assert (done.stdout, done.stderr) == (f"True {said}\n", "")
