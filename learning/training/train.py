"""Training: one loop, read from top to bottom. On a CPU the same command gives the same bits.

Whatever is random in step n is drawn from a generator of (seed, n, rank), so a run that was
interrupted goes on exactly as it would have, from the last stored state. Bits are promised on the
CPU only: on CUDA, the gradients of bilinear interpolation and of gathering pixels are sums in no
fixed order.

In one process on a GPU, a step of agents whose networks are computed together is one CUDA graph
(graphed.py).

Several processes, one a GPU or a core, train together under `torchrun`: each draws its own batch,
and gradients are averaged (torch's DistributedDataParallel).

Source: Seita et al., ICRA 2021, appendix on training, for the preset `paper`; the preset `fast` is
ours.
"""

from __future__ import annotations

import contextlib
import hashlib
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.nn.parallel import DistributedDataParallel

from warp_deform.support.progress import progress_bar
from warp_deform.tasks.ground_truth import yaw_columns

from ..data.batches import agent_batch, check_lifts, check_traces, check_view, task_lifts
from ..data.dataset import Demonstrations
from ..models.gt_state import GtStateConfig
from ..models.precision import has_bfloat16_tiles
from ..models.traced import Traced, TracedConfig
from ..models.transporter import PRESETS, Transporter
from ..policy.policy import AGENTS, Agent, AgentDescription
from ..runs.folder import RunFolder
from ..runs.log import TrainingLog, load_tensorboard
from .config import TrainConfig
from .graphed import GraphedLosses, can_be_graphed
from .held_out import HeldOut
from .processes import join_processes
from .schedules import Schedule
from .start import begin
from .state import Trained, claim, on_cpu, state_steps
from .validation import Validation

__all__ = ["TrainReport", "train"]

_STREAM = 7
"""Keeps the generators of training apart from those of episodes."""


@dataclass(frozen=True)
class TrainReport:
    """What was trained.

    Attributes:
        demos: episodes that were learned from
        corrected: how many of these are corrected episodes
        labels: actions of demonstrations, and labels of corrected episodes, that were learned from;
            of an agent that learns outcomes the actions of both
        left_out: recordings of the folder that are no demonstrations, see `dataset.Demonstrations`
        steps: taken in all, of planned_steps
        snapshots: the steps of which there are snapshots
        validation: of snapshots on validation episodes, `n_success`, `n_episodes`, `mean_score` by
            step; one that solved all that every snapshot plays has played more, see `confirm`
        chosen: the step whose snapshot did best on them, as `eval` would choose; None without them
        loss: mean over the last logged steps [nat]; of an agent of outcomes in its own unit
        held_out: that of snapshots on held-out demonstrations by step, in the same unit
        seconds: of this call [s]
        cpu_seconds: that the steps of all calls took the process, without validation [s]
        weights_hash: of the last snapshot's weights
    """

    task: str
    agent: str
    preset: str
    demos: int
    corrected: int
    labels: int
    left_out: int
    seed: int
    steps: int
    planned_steps: int
    patience: int | None
    snapshots: tuple[int, ...]
    validation: dict[int, dict[str, Any]]
    chosen: int | None
    loss: float | None
    held_out: dict[int, float]
    seconds: float
    cpu_seconds: float
    stopped_early: bool
    weights_hash: str


def train(config: TrainConfig) -> TrainReport:
    """Train into a folder; go on where an earlier call with the same settings stopped.

    Raises:
        InputError: the data do not fit, the folder holds another run, or there is no such device.
        WarpDeformError: loss or weights are no longer finite, or something cannot be written.
    """
    began = time.perf_counter()
    run = RunFolder(config.out)
    joined = join_processes(config.device, threads=config.threads)
    with joined as process, run.nothing_by_halves():
        rank, world, device = process
        if config.exact:
            torch.backends.cudnn.allow_tf32 = False  # on by default, with 10 bits of mantissa
        # What is trained, and on what
        data = Demonstrations(
            config.data,
            task=config.task,
            count=config.demos,
            seed=config.seed,
            spare=config.hold_out,
            goal=config.goal,
            as_played=AGENTS[config.agent].sees == "traces",
        )
        check_lifts(data)
        plan = config.plan(len(data))
        description = _describe(config, data)
        agent, started = begin(config, description)
        agent = agent.to(device)
        held_out = HeldOut(agent, data.spared(config.hold_out)) if config.hold_out else None
        validation = Validation(
            run,
            episodes=plan.validate,
            confirm=plan.confirm,
            process=process,
            trained=data.seeds,
            goals=data.given_goals,
            task=config.task,
        )
        if not run.settings.exists():
            _rehearse(config, data, agent, plan, device)
        key = claim(
            run, config, plan, description, data, processes=world, start=started, write=rank == 0
        )
        process.wait()

        # Go on where a run was interrupted, perhaps while its last snapshot was validated
        trained = Trained(agent, plan, run, key)
        first = trained.restore()
        half = description.config.get("bfloat16", False)
        stopped = validation.evaluate([k for k in run.steps() if 0 < k <= first])
        network: nn.Module = agent
        if world > 1:  # buffers are constants
            network = DistributedDataParallel(agent, broadcast_buffers=False)
        due_steps, store = set(plan.snapshot_steps()), state_steps(plan)

        # A step's losses and gradient, of a batch that depends on nothing but seed, step and rank
        def batch(step: int, where: torch.device) -> tuple[Any, ...]:
            rng = np.random.default_rng([_STREAM, config.seed, step, rank])
            return _batch(data, agent, plan, config.augment, rng, where)

        def one_by_one(step: int) -> tuple[Any, torch.Tensor]:
            losses = network(*batch(step, device))
            return losses, trained.gradient(losses.total())

        stepper: Any = contextlib.nullcontext(one_by_one)
        if device.type == "cuda" and world == 1 and can_be_graphed(agent):
            here = torch.device("cpu")
            stepper = GraphedLosses(agent, lambda k: batch(k, here)[0], last=plan.steps)

        bar = progress_bar(
            f"train {config.task}",
            plan.steps,
            done=first,
            unit="steps",
            shown=config.progress and rank == 0,
        )
        log = TrainingLog(
            run,
            first,
            about={"precision": "bfloat16" if half else "float32"},
            tensorboard=config.tensorboard,
            enabled=rank == 0,
        )
        with log, bar as advance, stepper as losses_at:
            for step in range(first + 1, plan.steps + 1):
                if stopped:
                    break
                # One step of the optimiser
                losses, gradient = losses_at(step)
                lr = trained.optimizer.param_groups[0]["lr"] = plan.lr_at(step)
                trained.step(step, gradient)
                log.add(step, {"loss": losses.total(), **losses._asdict()}, lr=lr)

                # Snapshots, and what an interrupted run goes on from
                due, last = step in due_steps, step == plan.steps
                if due or last or step % store == 0:
                    log.check(step)
                    trained.check(step)
                    if rank == 0 and due:
                        record: dict[str, Any] = {"agent": asdict(description)}
                        if held_out is not None:
                            record["held_out"] = held_out.loss(trained.averaged())
                            log.mark(step, {"held_out/loss": record["held_out"]})
                        run.write_snapshot(step, on_cpu(trained.averaged()), record)
                    if rank == 0 and (last or step % store == 0):
                        log.flush()
                        trained.store(step)
                if due:
                    with log.paused():
                        stopped = validation.evaluate([step])
                    if rank == 0 and stopped and step % store:
                        log.flush()
                        trained.store(step)

                # What is reported meanwhile
                advance()
                loss_so_far = log.last_loss()
                parts = [
                    "" if loss_so_far is None else f"loss {loss_so_far:.3g}",
                    validation.note,
                ]
                advance.note = ", ".join(filter(None, parts))
                if due:
                    advance.milestone()
        if config.untrained and rank == 0:
            initial = dict(begin(config, description)[0].named_parameters())
            run.write_snapshot(0, on_cpu(initial), {"agent": asdict(description)})
        process.wait()
        steps = run.steps()
        return TrainReport(
            task=config.task,
            agent=config.agent,
            preset=config.preset,
            demos=len(data),
            corrected=data.corrected,
            labels=sum(data.lengths()),
            left_out=data.left_out,
            seed=config.seed,
            steps=steps[-1],
            planned_steps=plan.steps,
            patience=plan.patience,
            snapshots=tuple(steps),
            validation=validation.results,
            chosen=validation.chosen,
            loss=log.last_loss(),
            held_out=run.held_out(),
            seconds=time.perf_counter() - began,
            cpu_seconds=log.cpu_seconds(),
            stopped_early=steps[-1] < plan.steps,
            weights_hash=_hash(run.snapshot(steps[-1])),
        )


def _describe(config: TrainConfig, data: Demonstrations) -> AgentDescription:
    """The agent for a task at a preset."""
    lifts, yaws = task_lifts(data.task), data.task.place_yaws
    if issubclass(AGENTS[config.agent], Transporter):
        chosen = config.network or PRESETS[config.preset]
        sizes = replace(
            chosen,
            lifts=lifts,
            n_rotations_train=max(chosen.n_rotations_train, yaws),
            n_rotations_eval=yaws,
            exact=config.exact or chosen.exact,
            bfloat16=chosen.bfloat16 or _bfloat16(config),
        )
        return AgentDescription(task=config.task, agent=config.agent, config=asdict(sizes))
    if issubclass(AGENTS[config.agent], Traced):
        traced = AgentDescription(task=config.task, agent=config.agent, config={})
        return replace(traced, config=asdict(TracedConfig(lifts=lifts)))
    choices = GtStateConfig(
        lifts=lifts,
        one_rotation=yaws == 1,
        # Elsewhere yaws say nothing of the action, and a chain's are as good as noise.
        yaws=yaw_columns(data.task.ground_truth_rows) if yaws > 1 else (),
        cosines_less_one=not config.exact,
        exact=config.exact,
    )
    return AgentDescription(
        task=config.task,
        agent=config.agent,
        config=asdict(choices),
        state_size=data.state_size,
    )


def _bfloat16(config: TrainConfig) -> bool:
    """Whether to convolve in bfloat16; `paper` does so only when asked to, as it is a reference."""
    if config.precision == "auto":
        fast = config.preset == "fast" and not config.exact
        return fast and config.device == "cpu" and has_bfloat16_tiles()
    return config.precision == "bfloat16"


def _rehearse(
    config: TrainConfig, data: Demonstrations, agent: Agent, plan: Schedule, device: torch.device
) -> None:
    """Do once what may be refused, before the folder is claimed: a refusal leaves no run behind.

    Raises:
        InputError: the demonstrations cannot be shown to the agent, or TensorBoard is missing.
    """
    if config.tensorboard:
        load_tensorboard()
    for each in (data, data.spared(config.hold_out)) if config.hold_out else (data,):
        if isinstance(agent, Transporter):
            check_view(each)
        elif isinstance(agent, Traced):
            check_traces(each, agent.config)
    _batch(data, agent, plan, config.augment, np.random.default_rng(config.seed), device)


def _batch(
    data: Demonstrations,
    agent: Agent,
    plan: Schedule,
    augment: bool,
    rng: np.random.Generator,
    device: torch.device,
) -> tuple[Any, ...]:
    """Arguments of the agent's losses."""
    return agent_batch(
        data,
        agent,
        transitions=data.drawn(plan.batch, rng),
        rng=rng,
        augment=augment,
        mirror=plan.mirror,
        device=device,
    )


def _hash(path: Path) -> str:
    """BLAKE2b-128 of a snapshot's file."""
    return hashlib.blake2b(path.read_bytes(), digest_size=16).hexdigest()
