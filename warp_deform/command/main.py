"""The `warp-deform` command: a table of verbs, each imported only when it is called.

A verb is a function `verb(options) -> Outcome`. Its parameter is a frozen dataclass, a
`CommandOptions`, whose fields tyro turns into flags and whose docstrings into help; a union of such
classes makes sub-verbs. The verb computes, this module prints: the outcome alone goes to stdout,
progress and whatever libraries say go to stderr.

Exit codes: 0 done, 1 the run failed, 2 bad input, 130 interrupted.
"""

from __future__ import annotations

import contextlib
import ctypes
import difflib
import importlib
import io
import json
import os
import re
import sys
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple, Protocol, TypeVar

from tyro.conf import arg

from ..errors import InputError, Interrupted, WarpDeformError
from ..support.flag_range import check_flags
from ..support.garbage import collect_rarely
from ..support.version import __version__

__all__ = ["VERBS", "CommandOptions", "Outcome", "Verb", "main"]


class _Dataclass(Protocol):
    __dataclass_fields__: ClassVar[dict[str, Any]]


Config = TypeVar("Config", bound=_Dataclass)


class Verb(NamedTuple):
    """Where a verb's function stands, "module:function", and what it does in a few words.

    Attributes:
        kept: what an interruption leaves, and what to do then; empty where there is nothing to say
    """

    target: str
    summary: str
    kept: str = ""


_GOES_ON = "the same command goes on"

VERBS: dict[str, Verb] = {
    "list": Verb("warp_deform.command.verbs:list_tasks", "list the tasks and their Gymnasium ids"),
    "demo": Verb(
        "warp_deform.command.verbs:demo",
        "collect demonstrations of a task",
        kept=f"episodes already written are complete, {_GOES_ON}",
    ),
    "goals": Verb(
        "warp_deform.command.verbs:goals",
        "make a task's set of goals",
        kept=f"goals already written are complete, {_GOES_ON}",
    ),
    "replay": Verb(
        "warp_deform.command.verbs:replay",
        "simulate recorded episodes again and compare",
    ),
    "inspect": Verb(
        "warp_deform.command.verbs:inspect",
        "show statistics of a dataset and draw its episodes",
    ),
    "play": Verb("learning.command.page:play", "pick and place by mouse, in a page in the browser"),
    "view": Verb("learning.command.page:view", "watch recorded episodes in a page in the browser"),
    "convert": Verb(
        "learning.command.convert:convert", "convert datasets to and from other formats"
    ),
    "train": Verb(
        "learning.command.verbs:train",
        "train an agent on demonstrations",
        kept=f"all but the last steps is kept, {_GOES_ON} and ends with the same bits",
    ),
    "eval": Verb(
        "learning.command.verbs:evaluate",
        "choose a run's best snapshot and test it",
        kept=f"what was played is kept, {_GOES_ON}",
    ),
    "train-control": Verb(
        "learning.command.control:train_control",
        "train a policy of control at 20 Hz by gradients",
        kept=f"all but the last updates is kept, {_GOES_ON} and ends with the same bits",
    ),
    "eval-control": Verb("learning.command.control:eval_control", "test a run of train-control"),
    "demo-control": Verb(
        "learning.command.control:demo_control",
        "record what a run of train-control solves",
        kept=f"episodes already written are complete, {_GOES_ON}",
    ),
    "report": Verb(
        "learning.command.verbs:report",
        "write tables and learning curves beside the paper's",
    ),
    "sweep": Verb(
        "learning.command.verbs:sweep",
        "train and evaluate a whole grid of runs",
        kept=f"what is done is kept, {_GOES_ON}",
    ),
    "refine": Verb(
        "learning.command.refine:refine",
        "improve demonstrations by search",
        kept=f"episodes already written are complete, {_GOES_ON}",
    ),
    "correct": Verb(
        "learning.command.correct:correct",
        "have a teacher label what a policy runs into",
        kept=f"episodes already written are complete, {_GOES_ON}",
    ),
    "distill": Verb(
        "learning.command.distill:distill",
        "make a policy from nothing within a budget",
        kept=f"what is done is kept, {_GOES_ON}",
    ),
    "bench": Verb("warp_deform.command.verbs:bench", "time the simulator, alone or beside a peer"),
    "gradcheck": Verb(
        "warp_deform.command.verbs:gradcheck", "compare derivatives with finite differences"
    ),
    "franka": Verb(
        "hardware.command.franka:franka",
        "run the cable task on a Franka arm or its twin",
        kept="episodes already written are complete",
    ),
    "doctor": Verb(
        "warp_deform.command.verbs:doctor",
        "show versions, devices, caches and what is missing",
    ),
}


@dataclass(frozen=True, kw_only=True)
class CommandOptions:
    """Options that every verb has."""

    json: bool = False
    """Print one JSON object, and nothing else, on stdout."""
    task_module: Annotated[str | None, arg(metavar="MODULE")] = None
    """Module or .py file that registers tasks of your own. It is imported, so its code runs."""

    def configure(self, kind: type[Config], **further: Any) -> Config:
        """The configuration `kind`, a dataclass: the fields that it shares with these options.

        further: fields that they do not have
        """
        own = {field.name for field in fields(self)}
        shared = {f.name: getattr(self, f.name) for f in fields(kind) if f.name in own}
        return kind(**shared, **further)


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What a verb found out: `data` is its JSON object, `text` says the same to people.

    `failure`, one line, means that the run did not do what was asked: it goes to stderr and the
    exit code is `failure_code`: 1, or 2 where some of the input was wrong.
    """

    data: Mapping[str, Any]
    text: str
    failure: str | None = None
    failure_code: int = 1


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with the arguments `argv` (default: the process's); returns the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if argv is None:  # the process is the command's own
        collect_rarely()
    _open_closed_streams()
    try:
        return _dispatch(arguments)
    except InputError as error:
        return _complain(error, code=2)
    except WarpDeformError as error:
        return _complain(error, code=1)
    except KeyboardInterrupt as error:
        left = VERBS[arguments[0]].kept if arguments and arguments[0] in VERBS else ""
        if isinstance(error, Interrupted):
            left = str(error)
        return _complain("; ".join(filter(None, ["interrupted", left])), code=130)
    except BrokenPipeError:
        _discard_stdout()  # the reader went away (`| head`)
        return 1
    except OSError as error:
        code = _complain(error, code=1)
        try:
            sys.stdout.flush()
        except OSError:  # stdout itself is a file on a full disk
            _discard_stdout()
        return code


def _open_closed_streams() -> None:
    """Where the caller closed stdin, stdout or stderr (`>&-`), read and write nothing instead.

    A file that is opened later would get the stream's number and then what is printed.
    """
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(descriptor)
    sys.stdout = sys.stdout or open(1, "w", closefd=False)
    sys.stderr = sys.stderr or open(2, "w", closefd=False)


def _discard_stdout() -> None:
    """Let what is still to be printed go nowhere, so that Python does not complain at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _dispatch(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(_usage())
        return 0
    name, *rest = arguments
    if name in ("-V", "--version"):
        print(f"warp-deform {__version__}")
        return 0
    if name == "--completion":
        print(_completion(), end="")
        return 0
    if name not in VERBS:
        near = difflib.get_close_matches(name, VERBS, n=1, cutoff=0.5)
        hint = f"did you mean `{near[0]}`?" if near else f"use one of: {', '.join(VERBS)}"
        raise InputError(f"unknown verb {name!r}; {hint}")
    verb = _load(VERBS[name].target)
    options = _parse(f"warp-deform {name}", verb, rest)
    if options is None:
        return 0
    check_flags(options)
    with _stdout_to_stderr():
        if options.task_module is not None:
            from ..tasks.external import import_tasks

            import_tasks(options.task_module)
        outcome = verb(options)
    print(
        json.dumps(outcome.data, allow_nan=False, default=_plain) if options.json else outcome.text
    )
    sys.stdout.flush()
    if outcome.failure is None:
        return 0
    return _complain(outcome.failure, code=outcome.failure_code)


def _usage() -> str:
    width = max(map(len, VERBS))
    return "\n".join(
        [
            "usage: warp-deform VERB [OPTIONS]     (warp-deform VERB --help explains one verb)",
            "",
            *(f"  {name:<{width}}  {verb.summary}" for name, verb in VERBS.items()),
            "",
            "  -h, --help     show this text",
            "  --completion   a script that completes verbs, flags and tasks in the shell",
            "  -V, --version  show the version",
        ]
    )


def _completion() -> str:
    """The script that `--completion` prints: flags are those of every verb's help."""
    from ..control.registry import CONTROL_TASKS
    from ..tasks.external import offered
    from ..tasks.registry import FURTHER_TASKS, TASKS
    from .completion import completion_script

    tasks = (*TASKS, *FURTHER_TASKS, *offered(), *CONTROL_TASKS)
    words: dict[str, list[str]] = {}
    for name, verb in VERBS.items():
        said = io.StringIO()
        with contextlib.redirect_stdout(said):
            _parse(f"warp-deform {name}", _load(verb.target), ["--help"])
        flags = dict.fromkeys(re.findall(r"(?<![\w-])--[a-z](?:[\w-]*\w)?", said.getvalue()))
        takes_task = re.search(r"^\W*TASK\b", said.getvalue(), re.MULTILINE)
        words[name] = [*flags, *(tasks if takes_task else ())]
    return completion_script(words)


def _load(target: str) -> Callable[[Any], Outcome]:
    module, function = target.split(":")
    loaded: Callable[[Any], Outcome] = getattr(importlib.import_module(module), function)
    return loaded


def _parse(
    prog: str, verb: Callable[[Any], Outcome], arguments: list[str]
) -> CommandOptions | None:
    """The verb's options from its arguments, or None when help was asked for and printed.

    Raises:
        InputError: the arguments do not fit the options; tyro's own text, on one line.
    """
    import tyro

    if any(each.startswith("--tyro-") for each in arguments):
        raise InputError("tyro's completions are of one verb; use `warp-deform --completion`")
    hints = typing.get_type_hints(verb, include_extras=True)
    kind = next(hint for name, hint in hints.items() if name != "return")
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            options: CommandOptions = tyro.cli(
                kind, prog=prog, args=arguments, config=(tyro.conf.FlagCreatePairsOff,)
            )
    except SystemExit as leaving:
        if not leaving.code:
            return None
        raise InputError(f"{_essence(said.getvalue())}; see `{prog} --help`") from None
    return options


def _essence(boxed: str) -> str:
    """What tyro's box of several paragraphs says, on one line: what is wrong and what was meant."""
    # the title stands in the frame's upper edge or, on a terminal without frames, is underlined
    text = "\n".join(line.strip("│╭╰ ") for line in boxed.splitlines())
    _, *paragraphs = re.split(r"^.*[─-]{3,}.*$", text, flags=re.MULTILINE)
    wrong, *others = (" ".join(part.split()) for part in paragraphs)
    helpful = ("Perhaps you meant", "Available subcommands")
    meant = [part[0].lower() + part[1:] for part in others if part.startswith(helpful)]
    return "; ".join([wrong.rstrip("."), *meant]).rstrip(".")


@contextlib.contextmanager
def _stdout_to_stderr() -> Iterator[None]:
    """Send what Python and native libraries print on stdout to stderr for a while."""
    sys.stdout.flush()
    stdout = os.dup(1)
    os.dup2(2, 1)
    try:
        with contextlib.redirect_stdout(sys.stderr):
            yield
    finally:
        # C's stdout has a buffer of its own: PyBullet's greeting would come out after the report.
        ctypes.CDLL(None).fflush(None)
        os.dup2(stdout, 1)
        os.close(stdout)


def _plain(value: object) -> object:
    """JSON's form of a path or of a NumPy scalar or array."""
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"cannot write {type(value).__name__} as JSON")


def _complain(error: object, *, code: int) -> int:
    print(f"warp-deform: {' '.join(str(error).split())}", file=sys.stderr)
    return code
