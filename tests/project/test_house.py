"""House rules that a machine can see: sizes, names, and what must not be in the repository."""

from __future__ import annotations

import re
import tomllib

import cv2
from fixtures.places import ROOT, TESTS

import warp_deform
from warp_deform.command.doctor import DEPENDENCIES

FOLDERS = ("warp_deform", "learning", "hardware", "tests", "examples", "benchmarks")
FILES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))
TEXTS = sorted(
    path
    for path in [*FILES, *ROOT.glob("*.*"), *(ROOT / "docs").rglob("*.md"), ROOT / "Makefile"]
    if path.suffix in {".py", ".md", ".toml", ".txt", ".cff", ""}
    and path.is_file()
    and path.name != ".git"  # of a worktree: a file that says where the repository is
)
BANNED_NAMES = {"utils", "util", "common", "helpers", "helper", "misc", "manager", "managers"}
MACHINE_PATH = re.compile(r"(?<![\w.])/(?:wo[r]k|ro[o]t|ho[m]e|t[m]p)/[a-z]")
LEFT_UNDONE = re.compile(r"\b(TO[D]O|FIX[M]E|XX[X]|NotImplemented[E]rror)\b")


def test_python_files_are_short_and_well_named() -> None:
    """A longer one is a place to ask whether it holds two ideas."""
    assert [path for path in FILES if len(path.read_text().splitlines()) > 400] == []
    names = {path: path.relative_to(ROOT).with_suffix("").parts for path in FILES}
    assert [path for path, parts in names.items() if BANNED_NAMES & set(parts)] == []
    assert len(FILES) > 800


def test_texts_hold_no_machine_path_and_nothing_undone() -> None:
    texts = {path: path.read_text() for path in TEXTS}
    assert [path for path, text in texts.items() if MACHINE_PATH.search(text)] == []
    assert [path for path, text in texts.items() if LEFT_UNDONE.search(text)] == []
    assert MACHINE_PATH.search("/" + "tmp/a") and LEFT_UNDONE.search("TO" + "DO: later")


def test_tests_stand_in_the_rooms_of_what_they_test() -> None:
    rooms = [
        folder.relative_to(TESTS)
        for package in ("warp_deform", "learning", "hardware")
        for folder in (TESTS / package).iterdir()
        if any(folder.glob("test_*.py"))
    ]
    assert len(rooms) > 30
    homes = {room: (ROOT / room, (ROOT / room).with_suffix(".py")) for room in rooms}
    assert [
        room for room, (folder, file) in homes.items() if not (folder.is_dir() or file.is_file())
    ] == []


def test_readme_is_short() -> None:
    for readme in ROOT.glob("README.md"):
        assert len(readme.read_text().splitlines()) <= 120


def test_readme_moves_and_pictures_are_small() -> None:
    """A picture that is loaded with a page has 2 MB at most; the README's has many frames."""
    (picture,) = re.findall(r"!\[[^\]]+\]\((\S+)\)", (ROOT / "README.md").read_text())
    moving = cv2.imreadanimation(str(ROOT / picture))[1]
    assert len(moving.frames) > 50 and moving.loop_count == 0
    pictures = [path for path in (ROOT / "docs" / "images").iterdir() if path.is_file()]
    assert ROOT / picture in pictures
    assert [path.name for path in pictures if path.stat().st_size > 2e6] == []


def test_constraints_pin_versions_and_name_no_host() -> None:
    lines = [
        line
        for line in (ROOT / "constraints.txt").read_text().splitlines()
        if not line.startswith("#")
    ]
    assert all(re.fullmatch(r"[\w.-]+==[\w.]+", line) for line in lines)


def test_dependencies_are_pinned_and_examined_by_doctor() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    needed = {re.split(r"[\[><=; ]", line)[0] for line in project["dependencies"]}
    assert needed == set(DEPENDENCIES)
    pinned = (ROOT / "constraints.txt").read_text().lower().replace("_", "-")
    assert [name for name in sorted(needed) if f"{name}==" not in pinned] == []


def test_version_is_the_same_everywhere() -> None:
    citation = (ROOT / "CITATION.cff").read_text()
    assert f"\nversion: {warp_deform.__version__}\n" in citation
    assert re.fullmatch(r"\d+\.\d+\.\d+", warp_deform.__version__)


def test_slow_files_exist_and_are_some() -> None:
    slow = (ROOT / "tests" / "slow.txt").read_text().split()
    assert slow == sorted(set(slow)) and all((ROOT / name).is_file() for name in slow)
    assert 0 < len(slow) < 0.6 * len(list((ROOT / "tests").rglob("test_*.py")))
