"""Training: one loop, read from top to bottom. The same command gives the same bits.

Whatever is random in step n is drawn from a generator of (seed, n, rank), so a run that was
interrupted goes on exactly as it would have, from the last stored state.

Several processes, one a GPU or a core, train together under `torchrun`: each draws its own batch,
and gradients are averaged (torch's DistributedDataParallel).

Source: Seita et al., ICRA 2021, appendix on training, for the preset `paper`; the preset `fast` is
ours.
"""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from warp_deform.episodes import versions
from warp_deform.errors import InputError
from warp_deform.progress import progress_bar
from warp_deform.tasks.registry import task as find_task

from .batches import image_batch, state_batch, task_lifts
from .dataset import Demonstrations
from .log import TrainingLog
from .models.adam import KerasAdam
from .models.gt_state import GtStateConfig
from .models.transporter import PRESETS, Transporter
from .place import place
from .policy import AGENTS, Agent, AgentDescription, make_agent
from .snapshots import RunFolder, read_json, write_json

__all__ = ["SCHEDULES", "Schedule", "TrainConfig", "TrainReport", "train"]

_STREAM = 7
"""Keeps the generators of training apart from those of episodes."""


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """How long and in which steps to train."""

    steps: int
    """Steps of the optimiser, which the original calls iterations."""
    batch: int
    """Moments a step and process."""
    lr: float
    """Greatest step size of Adam."""
    warmup: int = 0
    """Steps over which the step size grows from 0."""
    decay: bool = False
    """Let the step size fall to 0 like a cosine."""
    ema: float = 0.0
    """Snapshots hold weights averaged over 1 / (1 - ema) steps or so; 0: weights as they are."""
    snapshots: int = 10
    """Snapshots, evenly spread, the last one at the end."""


SCHEDULES = {
    "paper": Schedule(steps=20_000, batch=1, lr=1e-4),
    "fast": Schedule(steps=4000, batch=1, lr=1e-3, warmup=100, decay=True, ema=0.998, snapshots=4),
}
"""By the names of the command line, for agents over pictures."""
_STATE_SCHEDULES = {
    "paper": Schedule(steps=20_000, batch=128, lr=2e-4),
    "fast": Schedule(steps=4000, batch=128, lr=1e-3, warmup=100, decay=True, ema=0.99, snapshots=4),
}


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """What to train, and how.

    demos: demonstrations to learn from, drawn by `seed`; None takes all that `data` holds
    schedule: None takes the preset's
    threads: of torch, a process; another number may change the last bits
    validate: validation episodes that every snapshot plays; 0 plays none
    patience: stop when so many snapshots in a row brought no better validation; None never stops
    untrained: also a snapshot of the initial weights, step 0, where a learning curve begins
    progress: show a bar on a terminal
    """

    task: str
    agent: str
    data: Path
    out: Path
    demos: int | None = None
    seed: int = 0
    preset: str = "paper"
    schedule: Schedule | None = None
    augment: bool = True
    device: str = "cpu"
    threads: int = 1
    validate: int = 0
    patience: int | None = None
    tensorboard: bool = False
    untrained: bool = False
    progress: bool = True

    def __post_init__(self) -> None:
        find_task(self.task)
        if self.agent not in AGENTS:
            raise InputError(f"there is no agent {self.agent!r}; there are: {', '.join(AGENTS)}")
        if self.preset not in SCHEDULES:
            raise InputError(f"preset is {self.preset!r}; it must be one of {sorted(SCHEDULES)}")
        if self.seed < 0 or self.threads < 1 or self.validate < 0:
            raise InputError("seed and validate must be 0 or more, threads 1 or more")
        if self.patience is not None and (self.patience < 1 or not self.validate):
            raise InputError("patience must be 1 or more, and needs validation episodes")
        s = self.plan
        if s.steps < 1 or s.batch < 1 or not 1 <= s.snapshots <= s.steps:
            raise InputError("steps, batch and snapshots must be 1 or more, snapshots <= steps")
        if not (s.lr > 0 and 0 <= s.ema < 1 and s.warmup >= 0):
            raise InputError("lr must be positive, ema in [0, 1), warmup 0 or more")

    @property
    def plan(self) -> Schedule:
        """The schedule in force."""
        sees_state = not issubclass(AGENTS[self.agent], Transporter)
        return self.schedule or (_STATE_SCHEDULES if sees_state else SCHEDULES)[self.preset]


@dataclass(frozen=True)
class TrainReport:
    """What was trained.

    steps: taken in all; snapshots: the steps of which there are snapshots; loss: mean over the last
    logged steps [nat]; seconds: of this call [s]; weights_hash: of the last snapshot's weights
    """

    task: str
    agent: str
    preset: str
    demos: int
    seed: int
    steps: int
    snapshots: tuple[int, ...]
    loss: float | None
    seconds: float
    stopped_early: bool
    weights_hash: str


def train(config: TrainConfig) -> TrainReport:
    """Train into a folder; go on where an earlier call with the same settings stopped.

    Raises:
        InputError: the data do not fit, the folder holds another run, or there is no such device.
        WarpDeformError: the loss is no longer finite.
    """
    began = time.perf_counter()
    plan, run = config.plan, RunFolder(config.out)
    with place(config.device, threads=config.threads) as here:
        rank, world, device = here
        # What is trained, and on what
        data = Demonstrations(config.data, task=config.task, count=config.demos, seed=config.seed)
        description = _describe(config, data)
        agent = make_agent(description, seed=config.seed).to(device)
        if rank == 0:
            _claim(run, config, description, data, world)
        here.wait()
        names = dict(agent.named_parameters())
        optimizer = KerasAdam(agent.parameters(), lr=plan.lr)
        averaged = {name: each.detach().clone() for name, each in names.items()}

        # Go on where a run was interrupted
        tensors, first = run.read_state()
        if tensors:
            _restore(tensors, first, names, averaged, optimizer)
        log = TrainingLog(run, first, tensorboard=config.tensorboard, enabled=rank == 0)
        network: nn.Module = DistributedDataParallel(agent) if world > 1 else agent
        every = math.ceil(plan.steps / plan.snapshots)
        store = min(every, max(every // 10, 100))
        stopped = _stopped(run, config)

        shown = config.progress and rank == 0
        bar = progress_bar(f"train {config.task}", plan.steps, done=first, shown=shown)
        with bar as advance:
            for step in range(first + 1, plan.steps + 1):
                if stopped:
                    break
                # A batch that depends on nothing but seed, step and rank
                rng = np.random.default_rng([_STREAM, config.seed, step, rank])
                inputs = _batch(data, agent, plan.batch, config.augment, rng, device)

                # One step of the optimiser
                optimizer.param_groups[0]["lr"] = _lr(plan, step)
                optimizer.zero_grad(set_to_none=True)
                losses = network(*inputs)
                loss = losses.total()
                loss.backward()
                optimizer.step()
                _average(averaged, names, _decay(plan.ema, step))
                log.add(step, {"loss": loss, **losses._asdict()}, lr=_lr(plan, step))

                # Snapshots, and what an interrupted run goes on from
                last = step == plan.steps
                if rank == 0 and (last or step % every == 0):
                    record = {"agent": asdict(description)}
                    run.write_snapshot(step, _detached(averaged), record)
                if rank == 0 and (last or step % store == 0):
                    log.flush()
                    run.write_state(_state(names, averaged, optimizer), step)
                if config.validate and (last or step % every == 0):
                    if rank == 0:
                        _validate(run, config, step)
                    here.wait()
                    stopped = _stopped(run, config)
                advance()
        log.close()
        if config.untrained and rank == 0:
            initial = dict(make_agent(description, seed=config.seed).named_parameters())
            run.write_snapshot(0, _detached(initial), {"agent": asdict(description)})
        here.wait()
        steps = run.steps()
        return TrainReport(
            task=config.task,
            agent=config.agent,
            preset=config.preset,
            demos=len(data),
            seed=config.seed,
            steps=steps[-1],
            snapshots=tuple(steps),
            loss=log.last_loss(),
            seconds=time.perf_counter() - began,
            stopped_early=steps[-1] < plan.steps,
            weights_hash=_hash(run.snapshot(steps[-1])),
        )


def _describe(config: TrainConfig, data: Demonstrations) -> AgentDescription:
    """The agent for a task at a preset."""
    lifts, yaws = task_lifts(data.task), data.task.place_yaws
    if issubclass(AGENTS[config.agent], Transporter):
        preset = PRESETS[config.preset]
        sizes = replace(
            preset,
            lifts=lifts,
            n_rotations_train=max(preset.n_rotations_train, yaws),
            n_rotations_eval=yaws,
        )
        return AgentDescription(task=config.task, agent=config.agent, config=asdict(sizes))
    return AgentDescription(
        task=config.task,
        agent=config.agent,
        config=asdict(GtStateConfig(lifts=lifts, one_rotation=yaws == 1)),
        state_size=data.state_size,
    )


def _claim(
    run: RunFolder,
    config: TrainConfig,
    description: AgentDescription,
    data: Demonstrations,
    world: int,
) -> None:
    """Write the run's settings into its folder, or refuse one that holds another run."""
    deciding = {
        "agent": asdict(description),
        "preset": config.preset,
        "schedule": asdict(config.plan),
        "seed": config.seed,
        "augment": config.augment,
        "patience": config.patience,
        "validate": config.validate,
        "processes": world,
        "threads": config.threads,
        "device": config.device,
        "demonstrations": dict(zip(map(str, data.seeds), data.seals, strict=True)),
        "versions": versions(),
    }
    wanted = json.loads(json.dumps(deciding))
    if run.settings.exists():
        found = read_json(run.settings)
        different = [key for key in wanted if found.get(key) != wanted[key]]
        if different:
            raise InputError(
                f"{run.path} holds a run with another {different[0]}; choose another --out"
            )
        return
    run.create()
    write_json(run.settings, {**wanted, "data": str(config.data)})


def _batch(
    data: Demonstrations,
    agent: Agent,
    count: int,
    augment: bool,
    rng: np.random.Generator,
    device: torch.device,
) -> tuple[Any, ...]:
    """Arguments of the agent's losses."""
    if isinstance(agent, Transporter):
        batch = image_batch(data, agent, count=count, rng=rng, augment=augment)
        return (batch._replace(image=batch.image.to(device)),)
    tensors = state_batch(data, agent.config.lifts, count=count, rng=rng, augment=augment)
    return tuple(each.to(device) for each in tensors)


def _lr(plan: Schedule, step: int) -> float:
    """Step size at a step, counted from 1."""
    grown = min(1.0, step / plan.warmup) if plan.warmup else 1.0
    fallen = 0.5 * (1 + math.cos(math.pi * (step - 1) / plan.steps)) if plan.decay else 1.0
    return plan.lr * grown * fallen


def _decay(ema: float, step: int) -> float:
    """How much of the average is kept; less at first, so that the initial weights are forgotten."""
    return min(ema, step / (step + 10.0)) if ema else 0.0


@torch.no_grad()
def _average(averaged: Mapping[str, Tensor], names: Mapping[str, Tensor], keep: float) -> None:
    for name, each in averaged.items():
        each.lerp_(names[name].detach(), 1.0 - keep)


def _detached(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name: each.detach().cpu() for name, each in tensors.items()}


_MOMENTS = "exp_avg", "exp_avg_sq"


def _state(
    names: Mapping[str, nn.Parameter], averaged: Mapping[str, Tensor], optimizer: KerasAdam
) -> dict[str, Tensor]:
    """Weights, their averages and the optimiser's moments under one name each."""
    found = {f"weights.{name}": each for name, each in names.items()}
    found |= {f"averaged.{name}": each for name, each in averaged.items()}
    for name, parameter in names.items():
        for key in _MOMENTS:
            found[f"{key}.{name}"] = optimizer.state[parameter][key]
    return _detached(found)


def _restore(
    tensors: Mapping[str, Tensor],
    step: int,
    names: Mapping[str, nn.Parameter],
    averaged: Mapping[str, Tensor],
    optimizer: KerasAdam,
) -> None:
    """Put back what `_state` gave."""
    with torch.no_grad():
        for name, parameter in names.items():
            parameter.copy_(tensors[f"weights.{name}"])
            averaged[name].copy_(tensors[f"averaged.{name}"])
            optimizer.state[parameter] = {
                "step": torch.tensor(float(step)),
                **{key: tensors[f"{key}.{name}"].to(parameter.device) for key in _MOMENTS},
            }
    optimizer.param_groups[0]["steps"] = step


def _validate(run: RunFolder, config: TrainConfig, step: int) -> None:
    from .evaluation import Protocol, evaluate_snapshot

    evaluate_snapshot(run, step, Protocol(split="validation", episodes=config.validate))


def _stopped(run: RunFolder, config: TrainConfig) -> bool:
    """Whether validation has brought nothing better for as long as `patience` allows."""
    if config.patience is None:
        return False
    from .evaluation import Protocol, evaluate_snapshot, known

    protocol = Protocol(split="validation", episodes=config.validate)
    scores = [
        evaluate_snapshot(run, step, protocol).summary["mean_score"]
        for step in run.steps()
        if step and known(run, step, protocol)
    ]
    return len(scores) - 1 - int(np.argmax(scores or [0])) >= config.patience


def _hash(path: Path) -> str:
    """BLAKE2b-128 of a snapshot's file."""
    return hashlib.blake2b(path.read_bytes(), digest_size=16).hexdigest()
