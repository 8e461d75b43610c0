"""A folder that demonstrations are collected into: what it is of, and what has been attempted.

collection.json     what is collected; a run with other settings is refused
attempts.jsonl      one line per finished attempt, appended by whoever finished it
episode_*.parquet   the successes
surplus/            successes beyond those asked for, until more are asked for
"""

from __future__ import annotations

import contextlib
import fcntl
import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ..episodes import EpisodeReader, EpisodeWriter, episode_name, versions
from ..errors import InputError
from ..support.whole_file import whole_file

__all__ = ["Attempt", "Collection", "append_attempt", "check_seeds"]

_DESCRIPTION, _LEDGER, _SURPLUS = "collection.json", "attempts.jsonl", "surplus"
_OURS = (_LEDGER, _SURPLUS, "index.json")
_FORMAT = 1
MOST_SEED = 999_999_999
"""Greatest seed that the name of an episode's file holds."""
_DECIDING = ("warp-deform", "warp-lang", "newton", "numpy", "torch")
"""Packages whose version may change an episode's bits."""


@dataclass(frozen=True)
class Attempt:
    """How the episode of a seed ended.

    Attributes:
        reason: "solved", or why not
    """

    seed: int
    success: bool
    actions: int
    score: float
    reason: str


def check_seeds(first: int, count: int) -> None:
    """Raise InputError unless `count` seeds from `first` on can name episodes."""
    most = MOST_SEED + 1 - count
    if most < 0:
        raise InputError(f"so many episodes would need {count} seeds; there are {MOST_SEED + 1}")
    if not 0 <= first <= most:
        raise InputError(f"the seed is {first}; it must be 0 to {most}")


def append_attempt(folder: Path, attempt: Attempt) -> None:
    """Add a line to the ledger in one write, so that lines of several processes do not mix."""
    with (folder / _LEDGER).open("ab", buffering=0) as file:
        file.write(json.dumps(asdict(attempt), allow_nan=False).encode() + b"\n")


class Collection:
    """The folder while one process, the owner, collects into it with its workers.

    attempts: what is known so far by seed; a success whose file is missing does not count

    Raises:
        InputError: the folder belongs to another collection, or another process collects into it.
    """

    def __init__(self, folder: Path, description: Mapping[str, Any]) -> None:
        self.folder = Path(folder)
        self._made = [each for each in (self.folder, *self.folder.parents) if not each.exists()]
        EpisodeWriter(self.folder)  # makes the folder and clears what killed writers left
        self._describe({"format": _FORMAT, **description, "versions": _deciding_versions()})
        self.attempts: dict[int, Attempt] = {}

    @contextlib.contextmanager
    def owned(self) -> Iterator[Collection]:
        """Hold the folder, with everything that earlier runs left in it.

        Where what is done with it fails before anything has been attempted in a folder that was
        made for it, none is left.
        """
        with (self.folder / _LEDGER).open("a+b") as ledger:
            try:
                fcntl.flock(ledger, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise InputError(
                    f"another process is collecting into {self.folder}; wait for it to end or "
                    "choose another folder"
                ) from error
            ledger.seek(0)
            text = ledger.read()
            if text and not text.endswith(b"\n"):
                ledger.write(b"\n")  # a kill tore the last line: keep the next one whole
                ledger.flush()
            self._restore_surplus()
            self.attempts = self._known(text)
            try:
                yield self
            except Exception:
                self._withdraw()
                raise

    def _withdraw(self) -> None:
        """Remove the folder that was made for this, unless it holds what was worked for."""
        if not self._made or (self.folder / _LEDGER).stat().st_size or self._has_episodes():
            return
        for name in (_LEDGER, _DESCRIPTION):
            (self.folder / name).unlink(missing_ok=True)
        for folder in self._made:
            with contextlib.suppress(OSError):  # it holds something else
                folder.rmdir()

    def _known(self, ledger: bytes) -> dict[int, Attempt]:
        """Attempts that need not be repeated: failures of the ledger, and files that are there."""
        recorded = {a.seed: a for line in ledger.splitlines() if (a := _parse(line))}
        known = {seed: attempt for seed, attempt in recorded.items() if not attempt.success}
        reader = EpisodeReader(self.folder, control=True) if self._has_episodes() else None
        for info in () if reader is None else reader.infos():
            known[info.seed] = Attempt(info.seed, True, info.actions, info.score, "solved")
        return known

    def _has_episodes(self) -> bool:
        return any(self.folder.glob("*.parquet"))

    def _refuse_others(self) -> None:
        """Raise if the folder, new to us, holds what a collection would mix with or overwrite."""
        if self._has_episodes():
            raise InputError(
                f"{self.folder} holds episodes but no {_DESCRIPTION}: they were not collected "
                "into it; choose another folder"
            )
        for name in _OURS:
            if (self.folder / name).exists():
                raise InputError(
                    f"{self.folder} holds {name} but no {_DESCRIPTION}, so it is no collection; "
                    "choose another folder"
                )

    def _restore_surplus(self) -> None:
        for path in sorted((self.folder / _SURPLUS).glob("episode_*.parquet")):
            path.replace(self.folder / path.name)

    def keep(self, seeds: set[int]) -> None:
        """Leave the episodes of `seeds` alone in the folder; others go to the surplus."""
        for seed, attempt in self.attempts.items():
            if attempt.success and seed not in seeds:
                (self.folder / _SURPLUS).mkdir(exist_ok=True)
                name = episode_name(seed)
                (self.folder / name).replace(self.folder / _SURPLUS / name)

    def _describe(self, description: Mapping[str, Any]) -> None:
        """Write what is collected here, or compare it with what the folder says."""
        path = self.folder / _DESCRIPTION
        wanted = json.loads(json.dumps(description, allow_nan=False))
        if not path.exists():
            self._refuse_others()
            with whole_file(path) as temporary:
                temporary.write_text(json.dumps(wanted, indent=1, sort_keys=True) + "\n")
            return
        try:
            stored = json.loads(path.read_bytes())
        except (OSError, ValueError, RecursionError) as error:
            raise InputError(f"{path} is damaged; choose another folder") from error
        if stored != wanted:
            raise InputError(
                f"{self.folder} is a collection of another kind: {_difference(stored, wanted)}; "
                "choose another folder"
            )


def _parse(line: bytes) -> Attempt | None:
    """A ledger's line; None for one that was torn, whose seed is then attempted again."""
    try:
        record = json.loads(line)
        attempt = Attempt(**record)
    except (ValueError, TypeError, RecursionError):
        return None
    kinds = (int, bool, int, float | int, str)
    whole = all(isinstance(v, k) for v, k in zip(asdict(attempt).values(), kinds, strict=True))
    return attempt if whole else None


def _difference(stored: Any, wanted: Mapping[str, Any], path: str = "") -> str:
    """The first thing in which two descriptions differ; of all, what they are of."""
    if not isinstance(stored, dict):
        return f"{path.rstrip('.')} is {str(stored)[:60]} there"
    keys = sorted({*stored, *wanted}, key=lambda key: (key != "task", key))
    for key in keys:
        ours, theirs = wanted.get(key), stored.get(key)
        if ours != theirs:
            if isinstance(ours, dict):
                return _difference(theirs, ours, f"{path}{key}.")
            return f"{path}{key} is {str(theirs)[:60]} there and {str(ours)[:60]} here"
    return "nothing differs"


def _deciding_versions() -> dict[str, str]:
    return {name: version for name, version in versions().items() if name in _DECIDING}
