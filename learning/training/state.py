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
from ..policy.policy import AgentDescription
from ..runs.folder import RunFolder, read_json, write_json
from ..runs.log import LINE_STEPS
from .config import TrainConfig
from .schedules import Schedule

__all__ = ["Trained", "claim", "state_steps"]

_MOMENTS = "exp_avg", "exp_avg_sq"


class Trained:
    """Weights in training, their average over steps, and the optimiser's moments.

    Args:
        agent: whose weights
        plan: step sizes, and how long the average goes back
        run: where the state is kept
        key: digest of the settings, see `claim`; a state of other settings is refused
    """

    def __init__(self, agent: nn.Module, plan: Schedule, run: RunFolder, key: str) -> None:
        self._plan, self._run, self._key = plan, run, key
        self.weights = dict(agent.named_parameters())
        self.optimizer = KerasAdam(agent.parameters(), lr=plan.lr)
        self._average: dict[str, Tensor] | None = None
        """None where snapshots hold the weights as they are."""
        if plan.ema:
            self._average = {name: each.detach().clone() for name, each in self.weights.items()}

    @torch.no_grad()
    def averaged(self) -> dict[str, Tensor]:
        """What snapshots hold, by name."""
        if self._average is None:
            return {name: each.detach() for name, each in self.weights.items()}
        return self._average

    def step(self, number: int) -> None:
        """Take the optimiser's step, counted from 1, and count it into the average."""
        self.optimizer.step()
        if self._average is not None:
            with torch.no_grad():
                for name, each in self._average.items():
                    each.lerp_(self.weights[name].detach(), 1.0 - self._plan.kept_at(number))

    def check(self, step: int) -> None:
        """See that all weights are finite; an average keeps what ever was not.

        Raises:
            WarpDeformError: they are not.
        """
        if not all(bool(each.isfinite().all()) for each in self.averaged().values()):
            raise WarpDeformError(f"weights are not finite at step {step}; lower the step size")

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
        for parameter in self.weights.values():
            self.optimizer.state[parameter] = {
                "step": torch.tensor(float(step)),
                **{name: torch.zeros_like(parameter) for name in _MOMENTS},
            }
        wanted = self._tensors()
        stored_shapes, wanted_shapes = (
            {k: v.shape for k, v in each.items()} for each in (stored, wanted)
        )
        if key != self._key or stored_shapes != wanted_shapes:
            raise InputError(f"{self._run.state} is another run's; train into another folder")
        with torch.no_grad():
            for name, each in wanted.items():
                each.copy_(stored[name])
        self.optimizer.param_groups[0]["steps"] = step
        return step

    def _tensors(self) -> dict[str, Tensor]:
        """Weights, average and moments under one name each; not copied."""
        tensors = {f"weights.{name}": each.detach() for name, each in self.weights.items()}
        if self._average is not None:
            tensors |= {f"averaged.{name}": each for name, each in self._average.items()}
        for name, parameter in self.weights.items():
            for key in _MOMENTS:
                tensors[f"{key}.{name}"] = self.optimizer.state[parameter][key]
        return tensors


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
    write: bool,
) -> str:
    """Write the run's settings into its folder (if `write`); returns their digest.

    Raises:
        InputError: the folder holds another run.
    """
    deciding = {
        "agent": asdict(description),
        "preset": config.preset,
        "schedule": asdict(plan),
        "seed": config.seed,
        "augment": config.augment,
        "hold_out": config.hold_out,
        "patience": config.patience,
        "validate": plan.validate,
        "processes": processes,
        "threads": config.threads,
        "device": config.device,
        "demonstrations": dict(zip(map(str, data.seeds), data.seals, strict=True)),
        "versions": versions(),
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
        "demonstrators": names,
        "revisions": [asdict(running_revision())],
    }
    write_json(run.settings, {**deciding, **described})
    return key


def _compare(run: RunFolder, wanted: Mapping[str, Any], stored: Mapping[str, Any]) -> None:
    """Refuse a folder whose settings are not those that are wanted."""
    if "rounded" in stored:
        raise InputError(
            f"{run.path} is a shared policy, not trained further; choose another --out"
        )
    for name, value in wanted.items():
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
