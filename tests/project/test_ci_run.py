"""`.ci/run` fails with whichever of its parts fails, and ends with what pytest said last."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest
from fixtures.places import ROOT

PASSED = "===== 7 passed, 1 skipped in 13.51s (0:00:13) ====="
FAILED = "===== 1 failed, 6 passed in 13.51s ====="
MAKE = """#!/bin/sh
case $1 in
    test) echo "....F"; echo "$CLOSING"; echo "make: leaving"; exit $TEST ;;
    lint) echo "lint was here"; exit $LINT ;;
    chromium) exit $CHROMIUM ;;
esac
"""


@pytest.mark.parametrize(
    ("fails", "closing", "last"),
    [
        ((), PASSED, PASSED),
        (("LINT",), PASSED, PASSED),
        (("TEST",), FAILED, FAILED),
        (("TEST", "LINT"), FAILED, FAILED),
        (("CHROMIUM",), PASSED, PASSED),
        (("TEST",), "", "pytest did not finish"),
    ],
)
def test_it_fails_with_any_part_and_ends_with_pytests_line(
    fails: tuple[str, ...], closing: str, last: str, tmp_path: Path
) -> None:
    (tmp_path / ".ci").mkdir()
    shutil.copy(ROOT / ".ci" / "run", tmp_path / ".ci")
    make = tmp_path / "make"
    make.write_text(MAKE)
    make.chmod(0o755)
    said = {part: "2" if part in fails else "0" for part in ("TEST", "LINT", "CHROMIUM")}
    path = f"{tmp_path}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        [tmp_path / ".ci" / "run"],
        env={**os.environ, **said, "CLOSING": closing, "PATH": path},
        capture_output=True,
        text=True,
    )
    assert done.returncode == (2 if fails else 0), done.stdout + done.stderr
    lines = done.stdout.splitlines()
    assert lines[-1] == last and "lint was here" in lines
    assert ("failed: see above" in lines) == bool(fails)
