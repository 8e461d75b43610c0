"""A run says which code made it: version, commit of a checkout, and whether it was edited."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from warp_deform import __version__
from warp_deform.support.revision import Revision, running_revision


def git(folder: Path, *arguments: str) -> str:
    who = ["-c", "user.name=a", "-c", "user.email=a@b.c", "-c", "commit.gpgsign=false"]
    done = subprocess.run(
        ["git", "-C", str(folder), *who, *arguments], capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


@pytest.fixture
def module(tmp_path: Path) -> Path:
    """A module in a checkout of one commit."""
    path = tmp_path / "package" / "module.py"
    path.parent.mkdir()
    path.write_text("a = 1\n")
    git(tmp_path, "init", "--quiet")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "--quiet", "-m", "first")
    return path


def test_a_checkout_has_a_commit_and_is_clean_or_not(module: Path) -> None:
    commit = git(module.parent, "rev-parse", "HEAD")
    assert running_revision(module) == Revision(__version__, commit, dirty=False)
    (module.parent / "notes.txt").write_text("no part of the code")
    running_revision.cache_clear()
    assert running_revision(module).dirty is False
    module.write_text("a = 2\n")
    running_revision.cache_clear()
    revision = running_revision(module)
    assert revision.dirty and str(revision) == f"{__version__} at {commit[:12]}, edited"


def test_a_package_inside_of_another_checkout_is_no_part_of_it(module: Path) -> None:
    """As in a virtual environment that lies in the user's own repository."""
    installed = module.parent / "site-packages" / "revision.py"
    installed.parent.mkdir()
    installed.write_text("")
    revision = running_revision(installed)
    assert revision == Revision(__version__) and str(revision) == __version__


def test_without_git_there_is_a_version(module: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(module.parent))
    running_revision.cache_clear()
    assert running_revision(module) == Revision(__version__)


def test_an_empty_checkout_has_no_commit(tmp_path: Path) -> None:
    path = tmp_path / "module.py"
    path.write_text("")
    git(tmp_path, "init", "--quiet")
    git(tmp_path, "add", ".")
    assert running_revision(path) == Revision(__version__)
