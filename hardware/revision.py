"""Which revision of the software made a recording, where it runs from a checkout."""

from __future__ import annotations

import subprocess
from pathlib import Path

__all__ = ["software_revision"]

_ROOT = Path(__file__).resolve().parent.parent


def software_revision(root: Path = _ROOT) -> str:
    """Return git's hash of the checkout in `root`, 40 digits, with "-dirty" where it was changed.

    Empty where that is no checkout (the installed package is none), or there is no git.
    """
    if not (root / ".git").exists():
        return ""
    command = ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=40",
               "--exclude=*"]  # fmt: skip
    try:
        said = subprocess.run(command, capture_output=True, text=True, check=True, timeout=10.0)
    except (OSError, subprocess.SubprocessError):
        return ""
    return said.stdout.strip()
