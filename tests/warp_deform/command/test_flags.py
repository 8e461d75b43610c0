"""What `--help` says of a flag is what the flag does."""

from __future__ import annotations

import dataclasses
import importlib
import re
import typing
from collections.abc import Iterator

import pytest

from warp_deform.command.main import VERBS, CommandOptions, main


def options() -> Iterator[tuple[str, type]]:
    """The options of every verb, and of every verb of a verb, by name."""
    for name, verb in VERBS.items():
        module, function = verb.target.split(":")
        called = getattr(importlib.import_module(module), function)
        hints = typing.get_type_hints(called, include_extras=True)
        wanted = next(hint for name, hint in hints.items() if name != "return")
        classes: list[type] = []
        queue = [wanted]
        while queue:
            hint = queue.pop()
            if isinstance(hint, type) and dataclasses.is_dataclass(hint):
                classes.append(hint)
                queue += typing.get_type_hints(hint, include_extras=True).values()
            else:
                queue += typing.get_args(hint)
        assert classes and all(dataclasses.is_dataclass(each) for each in classes)
        yield from ((name, each) for each in classes)


OPTIONS = list(options())


def test_every_verb_is_looked_at() -> None:
    assert {name for name, _ in OPTIONS} == set(VERBS)
    assert sum(name == "franka" for name, _ in OPTIONS) > 5, "sub-verbs too"
    assert sum(issubclass(kind, CommandOptions) for _, kind in OPTIONS) > len(VERBS)


@pytest.mark.parametrize(
    ("verb", "kind"), OPTIONS, ids=lambda each: getattr(each, "__name__", each)
)
def test_a_switch_is_off_unless_it_is_named(verb: str, kind: type) -> None:
    """One that is on by default would be rendered as `--no-NAME` beside the words for NAME."""
    for field in dataclasses.fields(kind):
        if field.type in ("bool", bool):
            assert field.default is False, f"{verb} --{field.name}"


@pytest.mark.parametrize("verb", VERBS)
def test_help_of_switches(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    left = [verb]
    while left:
        words = left.pop()
        assert main([*words.split(), "--help"]) == 0
        said = " ".join(re.sub(r"[│╭╰─╮╯]", " ", capsys.readouterr().out).split())
        if inner := re.match(rf"usage: warp-deform {words} \[-h\] {{([a-z,-]+)}}", said):
            left += [f"{words} {part}" for part in inner[1].split(",")]
        assert "(default: True)" not in said
        for negative in re.findall(r"(--no-[a-z-]+) (\S+ \S+)", said):
            assert negative[1].startswith(("Do not", "Keep agents")), negative
