"""Losses and costs of a training run: lines of `log.jsonl`, and TensorBoard's file if wanted."""

from __future__ import annotations

import contextlib
import json
import math
import os
import time
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import torch
from torch import Tensor

from warp_deform.errors import InputError, WarpDeformError
from warp_deform.support.extras import install_extra

from .folder import TENSORBOARD, RunFolder, check_fields

__all__ = ["LINE_STEPS", "TrainingLog", "cpu_seconds", "load_tensorboard",
           "read_log"]

LINE_STEPS = 50
"""Steps that a line of the log stands for."""


def load_tensorboard() -> Any:
    """The class that writes for TensorBoard.

    Raises:
        InputError: TensorBoard is not installed.
    """
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise InputError(
            f"TensorBoard is not installed; in the clone run: {install_extra('train')}"
        ) from error
    return SummaryWriter


class TrainingLog:
    """Mean losses of every `LINE_STEPS` steps, and what they cost.

    seconds [s] and cpu_seconds [s], of all threads of this process, are those of the steps of a
    line: what lies in `paused` does not count.

    As a context manager it writes what there is, however training ends.

    Args:
        run: whose log
        about: what every line says besides
        step: what an earlier call logged after this step is forgotten: it is done again
        tensorboard: write for TensorBoard too
        enabled: whether this process writes files

    Raises:
        InputError: the log is damaged.
    """

    def __init__(
        self,
        run: RunFolder,
        step: int,
        *,
        about: Mapping[str, str] | None = None,
        tensorboard: bool,
        enabled: bool,
    ) -> None:
        self._about = dict(about or {})
        self._run, self._enabled = run, enabled
        self._sums: dict[str, Tensor] = {}
        self._lines = [line for line in read_log(run) if line["step"] <= step]
        self._count, self._since = 0, _clocks()
        self._board: Any = None
        if tensorboard and enabled:
            self._board = load_tensorboard()(str(run.path / TENSORBOARD), purge_step=step + 1)

    def __enter__(self) -> TrainingLog:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @contextlib.contextmanager
    def paused(self) -> Iterator[None]:
        """Do something meanwhile that is no step of training."""
        before = _clocks()
        yield
        passed = (now - then for now, then in zip(_clocks(), before, strict=True))
        self._since = tuple(since + each for since, each in zip(self._since, passed, strict=True))

    def add(
        self, step: int, losses: Mapping[str, Tensor], *, lr: float, last: bool = False
    ) -> None:
        """Count a step's losses in.

        Args:
            last: of all steps, so that a line is due in any case

        Raises:
            WarpDeformError: a line is due, and the mean loss is not finite.
        """
        for name, value in losses.items():
            # Where they are: to fetch them at every step would hold up a GPU.
            self._sums[name] = self._sums.get(name, 0) + value.detach()
        self._count += 1
        if step % LINE_STEPS and not last:
            return
        self.check(step)
        means = {name: float(total) / self._count for name, total in self._sums.items()}
        seconds, cpu = (now - then for now, then in zip(_clocks(), self._since, strict=True))
        costs = {"seconds": round(seconds, 3), "cpu_seconds": round(cpu, 3)}
        self._lines.append({"step": step, **means, "lr": lr, **costs, **self._about})
        if self._board is not None:
            for name, value in means.items():
                self._board.add_scalar(f"train/{name}", value, step)
        self._sums, self._count, self._since = {}, 0, _clocks()

    def mark(self, step: int, values: Mapping[str, float]) -> None:
        """Hand what was measured of a snapshot to TensorBoard, where it is written for."""
        for name, value in values.items() if self._board is not None else ():
            self._board.add_scalar(name, value, step)

    def check(self, step: int) -> None:
        """See that the losses since the last line are finite.

        Raises:
            WarpDeformError: they are not.
        """
        mean = float(self._sums["loss"]) / self._count if self._count else 0.0
        if not math.isfinite(mean):
            raise WarpDeformError(f"the loss is {mean} at step {step}; train with a lower --lr")

    def flush(self) -> None:
        """Write the lines so far, whole or not at all.

        Raises:
            WarpDeformError: they cannot be written.
        """
        if not self._enabled:
            return
        text = "".join(json.dumps(line) + "\n" for line in self._lines)
        temporary = self._run.log.with_name(f".{self._run.log.name}.{os.getpid()}.tmp")
        try:
            temporary.write_text(text)
            temporary.replace(self._run.log)
        except OSError as error:
            raise WarpDeformError(f"{self._run.log} cannot be written: {error.strerror}") from error
        finally:
            temporary.unlink(missing_ok=True)

    def close(self) -> None:
        """Write the lines so far and close TensorBoard's file.

        Steps after the last whole line are in none: the next call would log them again.
        """
        try:
            self.flush()
        finally:
            if self._board is not None:
                self._board.close()

    def last_loss(self) -> float | None:
        """Mean loss of the last line; None where nothing was logged."""
        return float(self._lines[-1]["loss"]) if self._lines else None

    def cpu_seconds(self) -> float:
        """What the steps of all lines took this process and those before it [s]."""
        return cpu_seconds(self._lines)


def read_log(run: RunFolder) -> list[dict[str, Any]]:
    """Lines of a run's log, none where nothing was logged.

    Raises:
        InputError: it is damaged.
    """
    if not run.log.exists():
        return []
    what = f"{run.log} is damaged; train into another folder"
    try:
        lines = [json.loads(line) for line in run.log.read_text().splitlines()]
    except ValueError as error:
        raise InputError(what) from error
    for line in lines:
        check_fields({"line": line}, {"line": dict}, what=what)
        check_fields(line, {"step": int, "loss": float}, what=what)
        check_fields({"cpu_seconds": 0.0, **line}, {"cpu_seconds": float}, what=what)
    return lines


def cpu_seconds(lines: Iterable[Mapping[str, Any]]) -> float:
    """CPU seconds of all lines; those of earlier versions have none, and count with nothing."""
    return float(sum(line.get("cpu_seconds", 0.0) for line in lines))


def _clocks() -> tuple[float, ...]:
    """The wall's clock and that of this process's CPU time [s]."""
    return time.perf_counter(), time.process_time()
