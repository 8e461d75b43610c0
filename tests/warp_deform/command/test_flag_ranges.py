"""Every number on the command line: what cannot be meant is one line and leaves nothing.

The rows are the flags themselves: a new one without a range fails here.
"""

from __future__ import annotations

import math
import types
import typing
from collections.abc import Iterator
from dataclasses import fields, make_dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from hardware.command.franka import franka
from warp_deform.command import main as cli
from warp_deform.command.main import CommandOptions, main
from warp_deform.errors import InputError
from warp_deform.support.flag_range import FlagRange, check_flags, check_seed, flag_range


def subverbs(name: str, verbs: Any) -> Iterator[tuple[str, type[CommandOptions]]]:
    """Words and options of every verb of a verb, and of theirs."""
    for each in typing.get_args(verbs):
        inner, words = typing.get_args(each)[0], f"{name} {each.__metadata__[0].name}"
        if isinstance(inner, type):
            yield words, inner
        else:
            yield from subverbs(words, inner)


FRANKA = dict(subverbs("franka", typing.get_type_hints(franka, include_extras=True)["options"]))
OWN: dict[str, type[CommandOptions]] = {
    verb: typing.get_type_hints(getattr(import_module(module), function))["options"]
    for verb, (target, *_) in cli.VERBS.items()
    if verb != "franka"
    for module, function in [target.split(":")]
}
VERBS = OWN | FRANKA
STEPS = ("board", "lens", "table", "camera", "points", "hand", "empty")
LINE = "cable-line-notarget"
NEEDED = {
    "franka capture-goal": ["--out", "g.png"],
    "franka collect": ["--out", "demos"], "demo": [LINE, "--out", "d"],
    "goals": [LINE, "--out", "d"], "replay": ["d"], "inspect": ["d"],
    "convert": ["d", "o", "--from", "deformable-ravens"],
    "train": [LINE, "--agent", "gt-mlp", "--data", "d", "--out", "r"], "eval": ["r"],
    "sweep": ["grid.toml"], "refine": ["d", "--out", "o"], "play": [LINE], "view": ["d"],
    "correct": ["r", "--out", "o", "--teacher", "mpc"], "distill": [LINE, "--out", "o"],
    "train-control": ["whip", "--out", "r"], "eval-control": ["r"],
    "demo-control": ["r", "--out", "d"],
}  # fmt: skip


def alternatives(hint: Any) -> tuple[Any, ...]:
    """What an annotation is the union of."""
    if typing.get_origin(hint) is typing.Annotated:
        return alternatives(typing.get_args(hint)[0])
    union = typing.get_origin(hint) in (types.UnionType, typing.Union)
    return typing.get_args(hint) if union else (hint,)


def kinds(hint: Any) -> set[type]:
    """The scalar types in an annotation."""
    scalars: set[type] = set()
    for kind in alternatives(hint):
        scalars |= set(typing.get_args(kind)) if typing.get_origin(kind) is tuple else {kind}
    return scalars


def printed(name: str, hint: Any) -> str:
    """The flag of a field, as the command takes it."""
    named = [each.name for each in hint.__metadata__ if getattr(each, "name", None)]
    return f"--{(named or [name])[0].replace('_', '-')}"


def numeric_flags() -> list[tuple[str, str, Any]]:
    """Verb, name and annotation of every flag that takes a number."""
    return [
        (verb, field.name, hint)
        for verb, options in VERBS.items()
        for field in fields(options)
        for hint in [typing.get_type_hints(options, include_extras=True)[field.name]]
        if kinds(hint) & {int, float}
    ]


FLAGS = numeric_flags()


def test_the_table_has_the_flags() -> None:
    assert {verb.removeprefix("franka ") for verb in FRANKA} == {
        "doctor", "capture-goal", "collect", "run", "replay", "score", "emulate",
        *(f"calibrate {step}" for step in STEPS),
    }  # fmt: skip
    names = {(verb, name) for verb, name, _ in FLAGS}
    assert {("franka run", "seed"), ("franka emulate", "chain"), ("franka calibrate lens", "size"),
            ("demo", "seed"), ("goals", "count"), ("train", "seed"), ("gradcheck", "seed"),
            ("eval", "first_seed"), ("refine", "budget"), ("convert", "workers"),
            } <= names  # fmt: skip
    assert len(FLAGS) >= 45


@pytest.mark.parametrize(("verb", "name", "hint"), FLAGS, ids=lambda value: str(value)[:20])
def test_every_number_has_a_range(verb: str, name: str, hint: Any) -> None:
    allowed = flag_range(hint)
    assert allowed is not None, f"{verb} --{name} takes any number"
    assert math.isfinite(allowed.low) and math.isfinite(allowed.high)
    many = any(typing.get_origin(kind) is tuple for kind in alternatives(hint))

    given = make_dataclass("Given", [(name, hint)])

    def refused(value: float) -> bool:
        try:
            check_flags(given((allowed.low, value) if many else value))
        except InputError as error:
            assert f"{printed(name, hint)} is" in str(error)
            return True
        return False

    assert not refused(allowed.low) and not refused(allowed.high)
    beyond = [allowed.low - 1, allowed.high + 1, 1e300, -1e300]
    assert all(map(refused, [*beyond, math.nan, math.inf, -math.inf]))


@pytest.mark.parametrize(("verb", "name", "hint"), FLAGS, ids=lambda value: str(value)[:20])
def test_what_cannot_be_meant_is_one_line_and_leaves_nothing(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    verb: str,
    name: str,
    hint: Any,
) -> None:
    monkeypatch.chdir(tmp_path)
    allowed = flag_range(hint)
    assert allowed is not None
    bad = [str(int(allowed.low) - 1)] if int in kinds(hint) else ["nan"]
    many = [kind for kind in alternatives(hint) if typing.get_origin(kind) is tuple]
    count = len([kind for kind in typing.get_args(many[0]) if kind is not ...]) if many else 1
    flag = printed(name, hint)
    code = main([*verb.split(), *NEEDED.get(verb, []), flag, *(bad * count)])
    said = capfd.readouterr()
    assert code == 2 and said.out == "" and list(tmp_path.iterdir()) == []
    (line,) = said.err.strip().splitlines()
    assert line.startswith(f"warp-deform: {flag} is {bad[0]}; allowed: ")


def test_what_is_left_out_or_has_no_range_is_not_checked() -> None:
    given = make_dataclass(
        "Given", [("a_b", typing.Annotated[int | None, FlagRange(0, 1)]), ("c", int)]
    )
    check_flags(given(None, -1))
    with pytest.raises(InputError, match="--a-b is 2; allowed: 0 to 1"):
        check_flags(given(2, -1))


@pytest.mark.parametrize("seed", [-1, 2**32, 1.5, "1", None])
def test_a_seed_is_a_number_that_numpy_takes(seed: Any) -> None:
    with pytest.raises(InputError, match="a seed is 0 to 4294967295"):
        check_seed(seed)
