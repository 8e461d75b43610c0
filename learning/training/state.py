"""What a training run goes on from: its settings, and the state of weights and optimiser."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import torch
from torch import Tensor, nn

from warp_deform.episodes import EpisodeReader, versions
from warp_deform.errors import InputError, WarpDeformError
from warp_deform.support.revision import running_revision

from ..data.dataset import Demonstrations
from ..models.adam import KerasAdam
from ..policy.policy import AGENTS, AgentDescription
from ..runs.folder import RunFolder, read_json, write_json
from ..runs.log import LINE_STEPS
from .config import TrainConfig
from .schedules import Schedule

__all__ = ["Trained", "claim", "state_steps"]

_MOMENTS = "exp_avg", "exp_avg_sq"


class Trained:
    """Weights in training, their average over steps, and the optimiser's moments.

    All weights lie in one vector, and the agent's are parts of it; so are moments and average. A
    step of hundreds of small tensors costs ten times as much.

    Args:
        agent: whose weights
        plan: step sizes, and how long the average goes back
        run: where the state is kept
        key: digest of the settings, see `claim`; a state of other settings is refused
    """

    def __init__(self, agent: nn.Module, plan: Schedule, run: RunFolder, key: str) -> None:
        self._plan, self._run, self._key = plan, run, key
        self._parameters = dict(agent.named_parameters())
        self._flat = nn.Parameter(
            torch.cat([each.detach().flatten() for each in self._parameters.values()])
        )
        for name, part in self._parts(self._flat.detach()).items():
            self._parameters[name].data = part
        self.optimizer = KerasAdam([self._flat], lr=plan.lr)
        parts = self._parts(self._flat.detach())
        self._faster = [
            part
            for name, part in parts.items()
            if plan.place_lr != 1.0 and name.startswith("place.")
        ]
        """Weights whose steps are `plan.place_lr` times as long."""
        self._mixing = [part for name, part in parts.items() if ".mixing." in name]
        """What gives Gaussians their weights: all the same where it is 0."""
        if plan.even:
            self._weigh_the_same()
        self._average: Tensor | None = None
        """None where snapshots hold the weights as they are."""
        if plan.ema:
            self._average = self._flat.detach().clone()

    def averaged(self) -> dict[str, Tensor]:
        """What snapshots hold, by name."""
        return self._parts(self._flat.detach() if self._average is None else self._average)

    def gradient(self, loss: Tensor) -> Tensor:
        """Of a loss, by all weights, one after another."""
        parameters = self._parameters.values()
        loss.backward()
        parts = (torch.zeros_like(each) if each.grad is None else each.grad for each in parameters)
        flat = torch.cat([each.flatten() for each in parts])
        for each in parameters:
            each.grad = None
        return flat

    @torch.no_grad()
    def step(self, number: int, gradient: Tensor) -> None:
        """Take the optimiser's step, counted from 1, and count it into the average."""
        self._flat.grad = gradient
        before = [part.clone() for part in self._faster]
        self.optimizer.step()
        for part, old in zip(self._faster, before, strict=True):
            part.lerp_(old, 1.0 - self._plan.place_lr)
        if number <= self._plan.even * self._plan.steps:
            self._weigh_the_same()
        if self._average is not None:
            self._average.lerp_(self._flat.detach(), 1.0 - self._plan.kept_at(number))

    def _weigh_the_same(self) -> None:
        for part in self._mixing:
            part.zero_()

    def check(self, step: int) -> None:
        """See that all weights are finite; an average keeps what ever was not.

        Raises:
            WarpDeformError: they are not.
        """
        weights = self._flat if self._average is None else self._average
        if not bool(weights.isfinite().all()):
            raise WarpDeformError(f"weights are not finite at step {step}: train with a lower --lr")

    def store(self, step: int) -> None:
        """Store the state after a step in place of what was stored before."""
        self._run.write_state(on_cpu(self._tensors()), step, key=self._key)

    def restore(self) -> int:
        """Put back what was stored; returns its step, 0 at the beginning.

        Raises:
            InputError: the state is damaged, or another run's.
        """
        stored, step, key = self._run.read_state()
        if not step:
            return 0
        self.optimizer.state[self._flat] = {
            "step": torch.tensor(float(step), device=self._flat.device),
            **{name: torch.zeros_like(self._flat.detach()) for name in _MOMENTS},
        }
        wanted = self._tensors()
        stored_shapes, wanted_shapes = (
            {k: v.shape for k, v in each.items()} for each in (stored, wanted)
        )
        if key != self._key or stored_shapes != wanted_shapes:
            raise InputError(f"{self._run.state} is another run's; train into another folder")
        for name, each in wanted.items():
            each.copy_(stored[name])
        self.optimizer.param_groups[0]["steps"] = step
        return step

    def _tensors(self) -> dict[str, Tensor]:
        """Weights, average and moments under one name each; parts of vectors, not copied."""
        vectors = {"weights": self._flat.detach()}
        if self._average is not None:
            vectors["averaged"] = self._average
        vectors |= {name: self.optimizer.state[self._flat][name] for name in _MOMENTS}
        return {
            f"{kind}.{name}": part
            for kind, vector in vectors.items()
            for name, part in self._parts(vector).items()
        }

    def _parts(self, vector: Tensor) -> dict[str, Tensor]:
        """What belongs to each parameter of a vector of all, by name and in its shape."""
        shapes = {name: each.shape for name, each in self._parameters.items()}
        parts = vector.split([shape.numel() for shape in shapes.values()])
        return {
            name: part.view(shape)
            for part, (name, shape) in zip(parts, shapes.items(), strict=True)
        }


def on_cpu(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Tensors without a graph, in main memory; not copied where they are there."""
    return {name: each.detach().cpu() for name, each in tensors.items()}


def state_steps(plan: Schedule) -> int:
    """Steps from one stored state to the next: whole lines of the log, so that none is torn."""
    every = max(plan.steps / plan.snapshots / 10, 100)
    return LINE_STEPS * math.ceil(every / LINE_STEPS)


def claim(
    run: RunFolder,
    config: TrainConfig,
    plan: Schedule,
    description: AgentDescription,
    data: Demonstrations,
    *,
    processes: int,
    start: str | None,
    write: bool,
) -> str:
    """Write the run's settings into its folder (if `write`); returns their digest.

    Args:
        start: digest of the weights that training begins with, None for random ones

    Raises:
        InputError: the folder holds another run.
    """
    deciding = {
        "agent": asdict(description),
        "preset": config.preset,
        "schedule": _described(plan),
        "seed": config.seed,
        "augment": config.augment,
        "hold_out": config.hold_out,
        "patience": plan.patience,
        "validate": plan.validate,
        "processes": processes,
        "threads": config.threads,
        "device": config.device,
        "demonstrations": dict(zip(map(str, data.seeds), data.seals, strict=True)),
        "versions": versions(),
        # as runs had it before there were choices
        **({} if start is None else {"start": start}),
        **({} if config.goal == "end" else {"goal": config.goal}),
        # `state_batch` lets what it moves leave the table, which it did not always
        **({"in_view": False} if AGENTS[config.agent].sees == "state" else {}),
    }
    text = json.dumps(deciding, sort_keys=True)
    key = hashlib.blake2b(text.encode(), digest_size=16).hexdigest()
    if not write:
        return key
    if run.settings.exists():
        settings = read_json(run.settings)
        _compare(run, json.loads(json.dumps(deciding)), settings)
        revision, known = asdict(running_revision()), settings.get("revisions", [])
        if revision not in known:
            write_json(run.settings, {**settings, "revisions": [*known, revision]})
        return key
    if run.state.exists() or run.log.exists() or run.steps():
        raise InputError(
            f"{run.path} holds parts of a run and no {run.settings.name}; choose another --out"
        )
    run.create()
    reader = EpisodeReader(config.data)
    names = sorted({reader.info(seed).demonstrator for seed in data.seeds})
    described = {
        "data": str(config.data),
        "left_out": data.left_out,
        "labels": sum(data.lengths()),
        "corrected": data.corrected,
        "demonstrators": names,
        **_goals(data),
        "revisions": [asdict(running_revision())],
    }
    write_json(run.settings, {**deciding, **described})
    return key


def _described(plan: Schedule) -> dict[str, Any]:
    """A schedule without what only some agents have, as other runs had it before."""
    described = asdict(plan)
    if plan.place_lr == 1.0:
        del described["place_lr"]
    if plan.even == 0.0:
        del described["even"]
    return described


def _goals(data: Demonstrations) -> dict[str, Any]:
    """How many episodes went for given goals, and the seeds of these, if any did."""
    given = data.given_goals
    return {"given_goals": len(given), "goal_seeds": sorted(set(given))} if given else {}


def _compare(run: RunFolder, wanted: Mapping[str, Any], stored: Mapping[str, Any]) -> None:
    """Refuse a folder whose settings are not those that are wanted."""
    if "rounded" in stored:
        raise InputError(
            f"{run.path} is a shared policy, not trained further; choose another --out"
        )
    for name, value in {"start": None, "goal": None, "in_view": None, **wanted}.items():
        before = stored.get(name)
        if before == value:
            continue
        if name == "versions" and isinstance(before, dict):
            for package in value:
                if before.get(package) != value[package]:
                    raise InputError(
                        f"{run.path} was begun with {package} {before.get(package)}, and "
                        f"{value[package]} is installed: bits would differ; install the former "
                        "again or choose another --out"
                    )
        raise InputError(f"{run.path} holds a run with another {name}; choose another --out")
