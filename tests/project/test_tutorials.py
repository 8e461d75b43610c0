"""The tutorials' commands and code run as a reader would run them, page by page."""

from __future__ import annotations

import re
import runpy
import shlex
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from fixtures.places import ROOT

from warp_deform.command.main import main

PAGES = sorted((ROOT / "docs" / "tutorials").glob("*.md"))
_BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_NUMBER = re.compile(r"-?\d+(?:\.\d+)?")


class Block(NamedTuple):
    language: str
    line: int
    text: str


def blocks(page: str) -> list[Block]:
    """The fenced blocks of a page, in order."""
    return [Block(m[1], page[: m.start()].count("\n") + 2, m[2]) for m in _BLOCK.finditer(page)]


def shape(text: str) -> list[str]:
    """The words of every line, with every number replaced and blanks counted once."""
    return [" ".join(_NUMBER.sub("#", line).split()) for line in text.splitlines()]


def missing(shown: str, printed: str) -> list[str]:
    """Lines that a page shows and that were not printed, whatever their numbers."""
    return [line for line in shape(shown) if line not in shape(printed)]


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.stem)
def test_tutorial_runs(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    variables: dict[str, Any] = {"__name__": page.stem}
    printed = ""
    for language, line, text in blocks(page.read_text()):
        if language == "text":
            assert missing(text, printed) == [], f"{page.name}:{line}: printed was\n{printed}"
            continue
        if language == "bash":
            for command in text.splitlines():
                program, *arguments = shlex.split(command)
                assert program == "warp-deform", f"{page.name}:{line}"
                assert main(arguments) == 0, f"{page.name}:{line}: {command}"
        else:
            assert language == "python", f"{page.name}:{line}: a block of {language!r}"
            lines = "\n" * (line - 1)  # so that an error names the page's line
            block = tmp_path / f"{page.stem}.py"
            block.write_text(lines + text)
            variables = runpy.run_path(str(block), init_globals=variables, run_name=page.stem)
        printed = capsys.readouterr().out


def test_each_tutorial_has_code_and_shows_what_it_prints() -> None:
    assert len(PAGES) == 5
    for page in PAGES:
        languages = {block.language for block in blocks(page.read_text())}
        assert {"python", "text"} <= languages <= {"python", "bash", "text"}, page.name


def test_a_line_that_is_not_printed_is_found() -> None:
    printed = "task    cable-line\nbead 3 is 12 mm off\n[-0.25  1.5]\n"
    assert missing("bead 0 is 0 mm off\n[-0.1 0.584]", printed) == []
    assert missing("bead 0 is 0 cm off", printed) == ["bead # is # cm off"]
