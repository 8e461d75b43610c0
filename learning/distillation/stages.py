"""What has been done of a distillation, and what it cost: a line a stage, in a file."""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from warp_deform.errors import InputError

__all__ = ["TEST", "Stages"]

TEST = "test"
"""Stage that the budget does not cover."""


class Stages:
    """Does stages once: of one that is done, a later call gives what it came to.

    CPU time is that of this process and its threads. A stage that was interrupted counts with all
    its parts; what a kill or a power cut cost is not known.

    Args:
        file: holds a line a stage, and one for every interruption
        told: stands before what is said of a stage on stderr
    """

    def __init__(self, file: Path, *, told: str) -> None:
        self._file, self._told = file, told
        self.done: dict[str, dict[str, Any]] = {}
        """What stages came to."""
        self.cost: dict[str, float] = {}
        """CPU seconds of stages, also of those that are not done."""
        for line in file.read_bytes().splitlines() if file.exists() else ():
            self._read(line)

    def __call__(self, name: str, work: Callable[[], dict[str, Any]], *, what: str) -> Any:
        """What a stage came to, JSON types; done now unless it was done before.

        Args:
            what: says what is done
        """
        if name in self.done:
            return self.done[name]
        if self._told:
            spent = f"{self.minutes():.1f} CPU minutes so far"
            print(f"{self._told}: {what}; {spent}", file=sys.stderr, flush=True)
        began, result = time.process_time(), None
        try:
            result = work()
        finally:
            self._write(name, time.process_time() - began, result)
        return self.done[name]

    def minutes(self, *, test: bool = False) -> float:
        """CPU minutes of all stages but the test, or of the test."""
        return math.fsum(s for name, s in self.cost.items() if (name == TEST) == test) / 60

    def _write(self, name: str, seconds: float, result: dict[str, Any] | None) -> None:
        line = json.dumps({"stage": name, "cpu_seconds": seconds, "result": result}).encode()
        with self._file.open("a+b", buffering=0) as file:
            file.seek(0)
            text = file.read()
            file.write((b"\n" if text and not text.endswith(b"\n") else b"") + line + b"\n")
        self._read(line)

    def _read(self, line: bytes) -> None:
        try:
            record = json.loads(line)
            name, seconds, result = record["stage"], record["cpu_seconds"], record["result"]
        except (ValueError, TypeError, KeyError):
            return  # torn by a kill: the stage is done again from what it left
        if not isinstance(seconds, float) or not isinstance(name, str):
            raise InputError(f"{self._file} is damaged; distill into another folder")
        self.cost[name] = self.cost.get(name, 0.0) + seconds
        if result is not None:
            self.done[name] = result
