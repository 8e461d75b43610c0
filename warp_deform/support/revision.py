"""Which code runs: the package's version and, where it runs from a checkout, git's revision.

A version says nothing of a checkout that lies some commits after it, or has been edited.
"""

from __future__ import annotations

import functools
import subprocess
from dataclasses import dataclass
from pathlib import Path

from .version import __version__

__all__ = ["Revision", "running_revision"]

_HERE = Path(__file__).resolve()


@dataclass(frozen=True)
class Revision:
    """What runs.

    Attributes:
        version: of the package
        commit: 40 hexadecimal digits; None where the package lies in no checkout, or git is missing
        dirty: whether tracked files differ from the commit; None without one
    """

    version: str
    commit: str | None = None
    dirty: bool | None = None

    @property
    def described(self) -> str:
        """As `git describe` has it: the commit, "-dirty" behind it where edited; empty without."""
        return (self.commit or "") + ("-dirty" if self.dirty else "")

    def __str__(self) -> str:
        """As people read it, "0.1.0 at 581dce6a1b2c, edited"."""
        if self.commit is None:
            return self.version
        return f"{self.version} at {self.commit[:12]}" + (", edited" if self.dirty else "")


@functools.cache
def running_revision(module: Path = _HERE) -> Revision:
    """The revision of the checkout that `module` is a tracked file of.

    A package that was installed into some other project's checkout is not taken for part of it.
    """
    if _git(module.parent, "ls-files", "--error-unmatch", module.name) is None:
        return Revision(__version__)
    commit = _git(module.parent, "rev-parse", "HEAD")
    changed = _git(module.parent, "status", "--porcelain", "--untracked-files=no")
    if commit is None or changed is None:
        return Revision(__version__)
    return Revision(__version__, commit.strip(), bool(changed.strip()))


def _git(folder: Path, *arguments: str) -> str | None:
    """What git says, None where it fails or is not there."""
    command = ["git", "-C", str(folder), "--no-optional-locks", *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout if done.returncode == 0 else None
