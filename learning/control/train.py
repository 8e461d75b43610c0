"""Training by gradients into a folder: one loop for all methods. The same command goes on."""

from __future__ import annotations

import statistics
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from warp_deform.control.tensor_worlds import TensorControlWorlds
from warp_deform.errors import InputError, WarpDeformError
from warp_deform.support.progress import progress_bar

from ..evaluation.protocol import FIRST_SEED
from ..runs.log import LINE_STEPS, TrainingLog
from ..training.processes import join_processes
from .actor import Actor, PlanActor
from .apg import Apg, ApgConfig
from .plan import PlanConfig, PlanLearner
from .play import play_control
from .run import ControlRun
from .saved import load_actor, save_actor
from .settings import ControlTrainSettings
from .shac import Shac, ShacConfig

__all__ = ["ControlTrainConfig", "ControlTrainReport", "Learner", "make_learner", "train_control"]

_METHODS: dict[str, tuple[type[ApgConfig | ShacConfig | PlanConfig], int]] = {
    "apg": (ApgConfig, 512),
    "shac": (ShacConfig, 512),
    "plan": (PlanConfig, 2048),
}
"""Settings of each method, and episodes among which its updates draw by default."""
_TIMED = 3
"""Updates that are timed to plan the others."""


class Learner(Protocol):
    """What every method is: see `Apg`, `Shac` and `PlanLearner`."""

    @property
    def actor(self) -> Actor | PlanActor:
        """What is trained."""

    def update(self, number: int) -> dict[str, float]:
        """One update of the weights, counted from 1; `loss`, `gradient`, and more."""

    def tensors(self) -> dict[str, Tensor]:
        """All that the next update goes on from, by name."""

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Put back what `tensors` gave."""


@dataclass(frozen=True, kw_only=True)
class ControlTrainConfig(ControlTrainSettings):
    """The settings of a run, checked, and what a program alone can choose."""

    own: ApgConfig | ShacConfig | PlanConfig | None = None
    """Of the method, in place of its defaults; `lr` changes it."""
    progress: bool = True
    """Show progress on stderr, see `warp_deform.support.progress`."""

    def __post_init__(self) -> None:
        if self.method not in _METHODS:
            raise InputError(f"method is {self.method!r}; it must be one of {', '.join(_METHODS)}")
        if self.drawn < self.worlds:
            raise InputError(
                f"an update draws {self.worlds} of {self.drawn} episodes; give --episodes "
                f"{self.worlds} or more, or fewer --worlds"
            )
        if self.updates is not None and self.updates < self.snapshots:
            raise InputError(
                f"{self.updates} updates do not make {self.snapshots} snapshots; take fewer"
            )

    @property
    def drawn(self) -> int:
        """Episodes among which an update draws."""
        return self.episodes or _METHODS[self.method][1]

    def method_config(self) -> ApgConfig | ShacConfig | PlanConfig:
        """The settings of the method in force."""
        own = self.own or _METHODS[self.method][0]()
        return own if self.lr is None else replace(own, lr=self.lr)

    def deciding(self) -> dict[str, Any]:
        """What a run is known by, in JSON types."""
        said = {**asdict(self), "episodes": self.drawn}
        for name in ("out", "progress", "own", "lr"):
            del said[name]
        if self.updates is not None:
            del said["minutes"]
        return {
            **said,
            **{f"{self.method}.{k}": v for k, v in asdict(self.method_config()).items()},
        }


@dataclass(frozen=True)
class ControlTrainReport:
    """What was trained.

    Attributes:
        updates: of the weights, in all calls
        snapshots: the updates after which there are snapshots
        validation: what these came to on validation seeds, see `PlayedControl.summary`
        chosen: the best of them
        loss: mean over the last logged updates; None before there are so many
        seconds: of this call [s]
        cpu_seconds: of the updates, in all calls [s]
    """

    task: str
    method: str
    seed: int
    updates: int
    snapshots: tuple[int, ...]
    validation: dict[int, dict[str, Any]]
    chosen: int
    loss: float | None
    seconds: float
    cpu_seconds: float


def train_control(config: ControlTrainConfig) -> ControlTrainReport:
    """Train into a folder; go on where an earlier call with the same settings stopped.

    Raises:
        InputError: the task cannot be trained, or the folder holds another run.
        WarpDeformError: the weights came to numbers that are none.
    """
    began = time.perf_counter()
    run = ControlRun(config.out)
    with join_processes("cpu", threads=1), run.nothing_by_halves():
        worlds = TensorControlWorlds(
            config.task, config.worlds, start="held", horizon=config.horizon, action_penalty=0.0
        )
        plan: dict[str, Any] = {"updates": config.updates}
        if run.settings.exists():
            plan = run.read_control()["plan"]
        elif config.updates is None:
            plan = {"updates": _planned(config, worlds)}
        key = run.claim(config.deciding(), plan)
        updates: int = plan["updates"]
        learner = make_learner(config, worlds, updates=updates)

        # Go on where a run was interrupted, perhaps while its last snapshot was validated
        stored, first, theirs = run.read_state()
        if stored:
            if theirs != key:
                raise InputError(f"{run.state} is another run's; train into another folder")
            learner.restore(stored)
        due = {round(updates * (k + 1) / config.snapshots) for k in range(config.snapshots)}
        for step in run.steps():
            if step <= first and not run.validation(step).is_file():
                _validate(run, step, worlds, config.validate)

        bar = progress_bar(
            f"train {config.task}", updates, done=first, unit="updates", shown=config.progress
        )
        log = TrainingLog(run, first, tensorboard=False, enabled=True)
        with log, bar as advance:
            for number in range(first + 1, updates + 1):
                told = learner.update(number)
                _check(told, number)
                lr = config.method_config().lr * (1.0 - (number - 1) / updates)
                values = {name: torch.tensor(each) for name, each in told.items()}
                log.add(number, values, lr=lr, last=number == updates)

                # Snapshots, and what an interrupted run goes on from
                if number in due:
                    save_actor(
                        run.path, learner.actor, task=config.task, updates=number,
                        method=config.method,
                    )  # fmt: skip
                if number % LINE_STEPS == 0 or number == updates:
                    log.flush()
                    run.write_state(learner.tensors(), number, key=key)
                if number in due:
                    with log.paused():
                        _validate(run, number, worlds, config.validate)

                # What is reported meanwhile
                advance()
                advance.note = _note(told, run)
                if number in due:
                    advance.milestone()
        return ControlTrainReport(
            task=config.task,
            method=config.method,
            seed=config.seed,
            updates=updates,
            snapshots=tuple(run.steps()),
            validation=run.validated(),
            chosen=run.chosen(),
            loss=log.last_loss(),
            seconds=time.perf_counter() - began,
            cpu_seconds=log.cpu_seconds(),
        )


def make_learner(
    config: ControlTrainConfig, worlds: TensorControlWorlds, *, updates: int
) -> Learner:
    """The method's actor in training, before its first update."""
    method = config.method_config()
    options = {"episodes": config.drawn, "updates": updates, "seed": config.seed}
    if isinstance(method, ApgConfig):
        return Apg(worlds, method, **options)
    if isinstance(method, PlanConfig):
        return PlanLearner(worlds, method, **options)
    return Shac(worlds, method, **options)


def _planned(config: ControlTrainConfig, worlds: TensorControlWorlds) -> int:
    """How many updates the minutes are good for, by what a few cost."""
    learner = make_learner(config, worlds, updates=1)
    learner.update(1)  # compiles kernels, and makes starts, which are kept
    costs = []
    for _ in range(_TIMED):
        began = time.process_time()
        learner.update(1)
        costs.append(time.process_time() - began)
    began = time.process_time()
    worlds.reset({slot: (config.worlds + slot) % config.drawn for slot in range(config.worlds)})
    starts = (time.process_time() - began) * (config.drawn / config.worlds - 1)
    seconds = 60 * config.minutes - starts
    return max(config.snapshots, int(seconds / statistics.median(costs)))


def _check(told: Mapping[str, float], number: int) -> None:
    if not np.isfinite([told["loss"], told["gradient"]]).all():
        raise WarpDeformError(
            f"the loss or its slope is no number after {number} updates; take a smaller lr"
        )


def _validate(run: ControlRun, step: int, worlds: TensorControlWorlds, episodes: int) -> None:
    """Let a snapshot play validation episodes, and keep what it came to."""
    actor, _ = load_actor(run.snapshot(step))
    first = FIRST_SEED["validation"]
    played = play_control(worlds, actor, range(first, first + episodes))
    run.write_validation(step, played.summary())


def _note(told: Mapping[str, float], run: ControlRun) -> str:
    """What stands beside the number of updates."""
    parts = [f"loss {told['loss']:.3g}"]
    if told["guards"]:
        parts.append(f"{told['guards']:.0f} guards")
    if told["unusable"]:
        parts.append(f"{told['unusable']:.0f} derivatives that are no numbers")
    for result in list(run.validated().values())[-1:]:
        parts.append(f"score {result['mean_score']:.3f} on validation seeds")
    return ", ".join(parts)
