"""What a task is: a scene distribution, a score, a demonstrator, and nothing that moves.

A task is a set of pure functions. `warp_deform.worlds` simulates; a task only says where things
start (`Layout`), reads what came out (`Snapshot`), scores it and proposes the next action.
"""

from __future__ import annotations

import abc
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from ..robots.primitive import PrimitiveConfig
from ..solver.config import SolverConfig

if TYPE_CHECKING:  # annotations only: listing the tasks loads no simulator
    import newton

    from ..objects.box import Box
    from ..objects.cable import Cable
    from ..objects.push import Push
    from ..objects.zone import Zone
    from ..rendering.images import Images
    from .free_space import FreeSpace

__all__ = ["Action", "Layout", "Snapshot", "Stage", "Task"]

Action = np.ndarray
"""(7,) float64: pick x, y [m], yaw [rad], place x, y [m], yaw [rad], lift [m]."""


@dataclass(frozen=True)
class Stage:
    """How high the tip carries what it holds [m], and how fast [m/s]."""

    lift: float
    speed: float


@dataclass(frozen=True, eq=False)
class Layout:
    """One sampled start of an episode.

    particle_q (P, 3) [m] and body_q (B, 7) position [m] and quat_xyzw, before settling
    targets: what the task aims at; shape and meaning are the task's ((n, 2) points or a pose)
    frame: pose (3,) x, y [m], yaw [rad] in which the targets were laid out, where a task needs it
    zones: marks that are drawn
    push: perturbation that follows the start, or None
    calm: start by damping (speeds clamped for a moment) instead of falling freely; for layouts
        that are constructed at rest, such as goals
    """

    particle_q: np.ndarray
    body_q: np.ndarray
    targets: np.ndarray
    zones: tuple[Zone, ...] = ()
    push: Push | None = None
    settle_seconds: float = 0.0
    calm: bool = False
    frame: np.ndarray | None = None

    def with_targets(self, targets: np.ndarray) -> Layout:
        """The same start with other targets (a goal from elsewhere)."""
        return replace(self, targets=np.array(targets, dtype=float))


@dataclass(frozen=True, eq=False)
class Snapshot:
    """State of one world at rest between two actions.

    particle_q, particle_qd (P, 3) [m], [m/s]; body_q (B, 7) position and quat_xyzw of the body's
    frame; body_qd (B, 6) linear, angular velocity. `images` renders on first use.
    """

    particle_q: np.ndarray
    particle_qd: np.ndarray
    body_q: np.ndarray
    body_qd: np.ndarray
    segments: tuple[range, ...]
    """Segmentation ids of zones and objects, in the order of `Task.drawn`."""
    render: Callable[[], Images] = field(repr=False)

    @cached_property
    def images(self) -> Images:
        """The three top-down views."""
        return self.render()


class Task(abc.ABC):
    """One task of the benchmark; instances are stateless and reusable."""

    name: ClassVar[str]
    goal_conditioned: ClassVar[bool] = False
    max_actions: ClassVar[int] = 20
    stages: ClassVar[tuple[Stage, ...]]
    success_score: ClassVar[float]
    """Score at and above which the task is solved."""
    ground_truth_size: ClassVar[int]
    objects: ClassVar[tuple[str, ...]] = ()
    """Names of what is simulated, for listings."""
    solver: ClassVar[SolverConfig] = SolverConfig()
    """Parameters of the physics."""
    primitive: ClassVar[PrimitiveConfig] = PrimitiveConfig()
    """Speeds and heights of the robot's motion."""

    def speed(self, lift: float) -> float:
        """Speed [m/s] of the loaded tip at a lift [m]: that of the stage with the nearest lift."""
        return min(self.stages, key=lambda stage: abs(stage.lift - lift)).speed

    def privileged_stage(self, segment: int, snapshot: Snapshot, previous: Stage | None) -> Stage:
        """Stage of a pick on what has the segmentation id `segment`, by the paper's hidden rule.

        snapshot: the state before the action; previous: the episode's stage before, None at first.
        A task with one stage needs no rule; one with several states its own here.
        """
        if len(self.stages) > 1:
            raise TypeError(f"{self.name} has {len(self.stages)} stages and no rule between them")
        return self.stages[0]

    @abc.abstractmethod
    def add_objects(self, builder: newton.ModelBuilder) -> tuple[Cable | Box, ...]:
        """Add one world's objects to `builder`, in any pose; every seed has the same ones."""

    @abc.abstractmethod
    def sample(self, rng: np.random.Generator, space: FreeSpace) -> Layout:
        """Draw a start. `space` is an empty table and knows the robot's reach."""

    def drawn(
        self, layout: Layout, objects: tuple[Cable | Box, ...]
    ) -> tuple[Cable | Box | Zone, ...]:
        """What is drawn, in creation order: zones first, as in the original."""
        return (*layout.zones, *objects)

    @abc.abstractmethod
    def score(self, layout: Layout, snapshot: Snapshot) -> float:
        """Progress in [0, 1]; the paper's partial score."""

    def solved(self, layout: Layout, snapshot: Snapshot) -> bool:
        """Whether the task is done."""
        return self.score(layout, snapshot) >= self.success_score

    @abc.abstractmethod
    def demonstrate(
        self, layout: Layout, snapshot: Snapshot, rng: np.random.Generator
    ) -> Action | None:
        """The scripted demonstrator's next action, or None when it sees nothing to do."""

    @abc.abstractmethod
    def ground_truth(self, layout: Layout, snapshot: Snapshot) -> np.ndarray:
        """State vector (ground_truth_size,) float32 of the paper's ground-truth baselines."""

    def goal_layout(self, layout: Layout) -> Layout:
        """Layout with the objects placed at the targets; only for goal-conditioned tasks."""
        raise TypeError(f"{self.name} has no goal")

    def goal_targets(self, snapshot: Snapshot) -> np.ndarray:
        """Targets that the state of a goal episode stands for; only for goal-conditioned tasks."""
        raise TypeError(f"{self.name} has no goal")
