"""Losses of a training run: lines of `log.jsonl`, and TensorBoard's file where it is asked for."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from warp_deform.errors import InputError, WarpDeformError

from .snapshots import RunFolder

__all__ = ["TrainingLog"]

_EVERY = 50


class TrainingLog:
    """Mean losses [nat] of every 50 steps.

    Args:
        run: whose log
        step: what an earlier call logged after this step is forgotten: it is done again
        tensorboard: write for TensorBoard too
        enabled: whether this process writes files

    Raises:
        InputError: the log is damaged, or TensorBoard is not installed.
    """

    def __init__(self, run: RunFolder, step: int, *, tensorboard: bool, enabled: bool) -> None:
        self._run, self._enabled = run, enabled
        self._sums: dict[str, Tensor] = {}
        self._lines = [line for line in self._read() if line["step"] <= step]
        self._count, self._since = 0, time.perf_counter()
        self._board: Any = None
        if tensorboard and enabled:
            try:
                from torch.utils.tensorboard import SummaryWriter
            except ImportError as error:
                raise InputError(
                    "TensorBoard is not installed; run: pip install 'warp-deform[train]'"
                ) from error
            self._board = SummaryWriter(str(run.path / "tensorboard"), purge_step=step + 1)

    def _read(self) -> list[dict[str, Any]]:
        if not self._run.log.exists():
            return []
        try:
            return [json.loads(line) for line in self._run.log.read_text().splitlines()]
        except ValueError as error:
            raise InputError(f"{self._run.log} is damaged; train into another folder") from error

    def add(self, step: int, losses: Mapping[str, Tensor], *, lr: float) -> None:
        """Count a step's losses in.

        Raises:
            WarpDeformError: their mean is no longer finite.
        """
        for name, value in losses.items():
            self._sums[name] = self._sums.get(name, torch.zeros(())) + value.detach().cpu()
        self._count += 1
        if step % _EVERY:
            return
        means = {name: float(total) / self._count for name, total in self._sums.items()}
        if not math.isfinite(means["loss"]):
            raise WarpDeformError(
                f"the loss is {means['loss']} at step {step}; lower the step size"
            )
        seconds = time.perf_counter() - self._since
        self._lines.append({"step": step, **means, "lr": lr, "seconds": round(seconds, 3)})
        if self._board is not None:
            for name, value in means.items():
                self._board.add_scalar(f"train/{name}", value, step)
        self._sums, self._count, self._since = {}, 0, time.perf_counter()

    def flush(self) -> None:
        """Write the lines so far."""
        if self._enabled:
            text = "".join(json.dumps(line) + "\n" for line in self._lines)
            temporary = self._run.log.with_suffix(".tmp")
            temporary.write_text(text)
            temporary.replace(self._run.log)

    def close(self) -> None:
        """Close TensorBoard's file."""
        if self._board is not None:
            self._board.close()

    def last_loss(self) -> float | None:
        """Mean loss of the last line [nat]; None where nothing was logged."""
        return float(self._lines[-1]["loss"]) if self._lines else None
