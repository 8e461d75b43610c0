"""Policies: `act(observation, goal)` from a snapshot, in simulation and on a robot alike.

    policy = load_policy("runs/line")
    action = policy.act(observation)

An observation is the environment's: `color` and `height`, and `goal_color` and `goal_height` where
the policy needs a goal that is not handed in. The lift is the network's own choice; the paper's
privileged rule, which reads the simulator, is `protocol.Protocol(stage_rule="privileged")`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch

from warp_deform.errors import InputError
from warp_deform.rendering.pixels import SHAPE
from warp_deform.tasks.cable_mask_goal import CableMaskGoal
from warp_deform.tasks.metrics import wrap_angle
from warp_deform.tasks.registry import task as find_task

from ..data.batches import task_lifts
from ..models.gt_state import GtState, GtState2Step, GtStateConfig
from ..models.traced import Traced, TracedConfig
from ..models.transporter import GoalSplit, GoalStack, Transporter, TransporterConfig
from ..runs.folder import RunFolder, read_snapshot
from .memory import Memory

__all__ = [
    "AGENTS",
    "Agent",
    "AgentDescription",
    "ImagePolicy",
    "Policy",
    "RetryingPolicy",
    "StatePolicy",
    "load_policy",
    "make_agent",
]

_REASON = 200
"""So much of what is wrong with a snapshot's weights is said [characters]."""
Agent = Transporter | Traced | GtState | GtState2Step

_LEVELS, _PIXELS = 10, 4
"""A picture has changed if so many colour levels differ in more than so many pixels; a bead of 1 cm
covers 8."""

AGENTS: dict[str, type[Transporter] | type[Traced] | type[GtState] | type[GtState2Step]] = {
    cls.name: cls for cls in (Transporter, GoalSplit, GoalStack, Traced, GtState, GtState2Step)
}
"""The agents by the names of the command line."""


@dataclass(frozen=True, kw_only=True)
class AgentDescription:
    """All that it takes to build an agent but its weights.

    Attributes:
        config: fields of its `TransporterConfig`, `TracedConfig` or `GtStateConfig`
        state_size: length of the ground truth, for agents that see it
    """

    task: str
    agent: str
    config: dict[str, Any]
    state_size: int | None = None

    def __post_init__(self) -> None:
        goal = find_task(self.task).goal_conditioned
        if self.agent not in AGENTS:
            raise InputError(f"there is no agent {self.agent!r}; there are: {', '.join(AGENTS)}")
        cls = AGENTS[self.agent]
        if issubclass(cls, Traced) and not isinstance(find_task(self.task), CableMaskGoal):
            raise InputError(
                f"{self.agent} traces the cable of masks, and {self.task} shows none; use it on "
                f"{CableMaskGoal.name}"
            )
        if not issubclass(cls, Transporter):  # the ground truth contains the goal
            return
        sees_goal = cls.pictures == 2
        if sees_goal and not goal:
            raise InputError(
                f"{self.agent} sees a goal image and {self.task} has none; use --agent transporter"
            )
        if goal and not sees_goal:
            raise InputError(
                f"{self.task} shows its goal in an image, which a {self.agent} does not see; use "
                "--agent goal-split or goal-stack"
            )


def make_agent(description: AgentDescription, *, seed: int = 0) -> Agent:
    """The agent with its initial weights.

    Raises:
        InputError: the configuration is not this agent's.
    """
    cls = AGENTS[description.agent]
    kind = _CONFIGS[cls.sees]
    unknown = description.config.keys() - {field.name for field in dataclasses.fields(kind)}
    if unknown:
        raise InputError(f"{description.agent} has no setting {min(unknown)!r}")
    values = {**description.config, "lifts": tuple(description.config["lifts"])}
    if issubclass(cls, Transporter):
        return cls(TransporterConfig(**values), seed=seed)
    if issubclass(cls, Traced):
        return cls(TracedConfig(**values), seed=seed)
    if description.state_size is None:
        raise InputError(f"{description.agent} needs the size of the state")
    choices = GtStateConfig(**{**values, "yaws": tuple(values.get("yaws", ()))})
    return cls(description.state_size, choices, seed=seed)


_CONFIGS: dict[str, type] = {
    "pictures": TransporterConfig, "traces": TracedConfig, "state": GtStateConfig,
}  # fmt: skip


class Policy(Protocol):
    """Acts on what is seen."""

    description: AgentDescription

    def act(
        self,
        observation: Mapping[str, np.ndarray],
        goal: Mapping[str, np.ndarray] | None = None,
        *,
        rng: np.random.Generator | None = None,
    ) -> np.ndarray:
        """Action (7,) float64: pick x, y, yaw, place x, y, yaw, lift [m, rad].

        Args:
            goal: `color` and `height` of the goal, where they are not part of the observation
            rng: for policies that draw their actions
        """


class ImagePolicy:
    """An agent over pictures; the same observation gives the same action."""

    def __init__(self, agent: Transporter | Traced, description: AgentDescription) -> None:
        self.agent, self.description = agent.eval(), description
        self._task = find_task(description.task)

    def act(
        self,
        observation: Mapping[str, np.ndarray],
        goal: Mapping[str, np.ndarray] | None = None,
        *,
        rng: np.random.Generator | None = None,
        avoid: Sequence[tuple[np.ndarray, float]] = (),
    ) -> np.ndarray:
        """See `Policy.act`.

        Args:
            avoid: points x, y and distances [m] from them within which nothing is to be picked

        Raises:
            InputError: a picture is missing, or is not a top-down picture of the table.
        """
        current = _picture(observation, "")
        aim = None
        if self.agent.pictures == 2:
            aim = _picture(observation, "goal_") if goal is None else _picture(goal, "")
        device = next(self.agent.parameters()).device
        image = self.agent.image(current, aim)[None].to(device)
        choice = self.agent.act(image, avoid=self._near(avoid) if len(avoid) else None)
        grid = self._task.grid
        pick, place = grid.to_world(choice.pick[0]), grid.to_world(choice.place[0])
        yaw = self._task.pick_yaw(current[0], pick)
        place_yaw = choice.place_yaw[0] if yaw == 0.0 else wrap_angle(yaw + choice.place_yaw[0])
        return np.array([*pick, yaw, *place, place_yaw, choice.lift[0]])

    def memory(self) -> Memory:
        """A new episode's memory, whose `Memory.avoid` is for `act`."""
        return Memory()

    def _near(self, discs: Sequence[tuple[np.ndarray, float]]) -> torch.Tensor:
        """Network pixels (1, H, W) bool on any of the discs."""
        config = self.agent.config
        rows, columns = config.shape
        grid = np.stack(np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"), axis=-1)
        world = self._task.grid.to_world(config.to_camera(grid))
        inside = [np.linalg.norm(world - point, axis=-1) < reach for point, reach in discs]
        return torch.from_numpy(np.any(inside, axis=0))[None]


class RetryingPolicy:
    """An image policy with a `Memory` of the episode: it picks elsewhere than what failed.

    `reset` it between episodes.
    """

    def __init__(self, policy: ImagePolicy) -> None:
        self.policy, self.description = policy, policy.description
        self.reset()

    def reset(self) -> None:
        """Forget the episode."""
        self._seen: np.ndarray | None = None
        self._memory = self.policy.memory()

    def act(
        self,
        observation: Mapping[str, np.ndarray],
        goal: Mapping[str, np.ndarray] | None = None,
        *,
        rng: np.random.Generator | None = None,
    ) -> np.ndarray:
        """See `Policy.act`."""
        color = _picture(observation, "")[0].astype(np.int16)
        changed = self._seen is None or _changed(color, self._seen)
        self._seen = color
        action = self.policy.act(observation, goal, avoid=self._memory.avoid(changed=changed))
        self._memory.chose(action[:2], action[3:5])
        return action


class StatePolicy:
    """A ground-truth baseline: it sees `ground_truth`, as in the environments' `info`."""

    def __init__(self, agent: GtState | GtState2Step, description: AgentDescription) -> None:
        self.agent, self.description = agent.eval(), description

    def act(
        self,
        observation: Mapping[str, np.ndarray],
        goal: Mapping[str, np.ndarray] | None = None,
        *,
        rng: np.random.Generator | None = None,
    ) -> np.ndarray:
        """See `Policy.act`; the goal is part of the ground truth, and the action is drawn by `rng`.

        The action may lie outside of the action space: nothing is clamped.

        Raises:
            InputError: the state is missing or has another size, or there is no `rng`.
        """
        state = np.asarray(observation.get("ground_truth", ()), dtype=np.float32)
        if state.shape != (self.description.state_size,):
            raise InputError(
                f"{self.agent.name} needs `ground_truth` of {self.description.state_size} numbers, "
                f"got shape {state.shape}"
            )
        if rng is None:
            raise InputError(f"{self.agent.name} draws its actions: hand in a generator as `rng`")
        device = next(self.agent.parameters()).device
        return self.agent.act(torch.from_numpy(state[None]).to(device), rng=rng)[0]


def load_policy(path: str | Path, *, device: str = "cpu") -> ImagePolicy | StatePolicy:
    """The policy of a snapshot file, or of a training run's folder.

    Of a run's snapshots, that is the one that `warp-deform eval` chose, or the last one.

    Raises:
        InputError: there is none, or it is not one of ours.
    """
    path = Path(path)
    file = path if path.suffix == ".safetensors" else RunFolder(path).chosen_snapshot()
    weights, record = read_snapshot(file)
    try:
        description = AgentDescription(**record["agent"])
        agent = make_agent(description)
        agent.load_state_dict(weights)
        if agent.config.lifts != task_lifts(find_task(description.task)):
            raise ValueError(f"lifts {list(agent.config.lifts)} are not those of the task's stages")
        if not all(bool(each.isfinite().all()) for each in agent.parameters()):
            raise ValueError("its weights are not finite")
    except (AttributeError, IndexError, KeyError, RuntimeError, TypeError, ValueError) as error:
        reason = " ".join(str(error).split())[:_REASON] or type(error).__name__
        raise InputError(f"{file} is no snapshot of this release's agents: {reason}") from error
    agent.to(device)
    if isinstance(agent, Transporter | Traced):
        return ImagePolicy(agent, description)
    return StatePolicy(agent, description)


def _changed(now: np.ndarray, before: np.ndarray) -> bool:
    return bool((np.abs(now - before).max(axis=-1) > _LEVELS).sum() > _PIXELS)


def _picture(source: Mapping[str, np.ndarray], prefix: str) -> tuple[np.ndarray, np.ndarray]:
    """Colour and height under the names `prefix` + "color" and "height"."""
    arrays = []
    for name, shape, kind in (("color", (*SHAPE, 3), np.uint8), ("height", SHAPE, np.float32)):
        array = source.get(prefix + name)
        if array is None:
            raise InputError(f"the observation has no {prefix + name!r}")
        array = np.asarray(array)
        if array.shape != shape or array.dtype != kind:
            raise InputError(
                f"{prefix + name}: shape {shape} of {np.dtype(kind)} is needed, got {array.shape} "
                f"of {array.dtype}"
            )
        arrays.append(array)
    return arrays[0], arrays[1]
