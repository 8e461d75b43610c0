"""What a task is: a scene distribution, a score, a demonstrator, and nothing that moves.

A task is a set of pure functions. `warp_deform.worlds` simulates; a task only says where things
start (`Layout`), reads what came out (`Snapshot`), scores it and proposes the next action.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from ..objects.bag import BagConfig
from ..objects.box import BoxConfig
from ..objects.push import Push
from ..objects.scene_object import SceneObject
from ..objects.zone import Zone
from ..rendering.drawables import Drawables
from ..rendering.images import Images
from ..rendering.pixels import TABLE_GRID, PixelGrid
from ..rendering.strand_mask import MaskLook
from ..robots.jaw_primitive import JawActionConfig
from ..robots.primitive import PrimitiveConfig, Stage
from ..xpbd.config import SolverConfig
from .free_space import FreeSpace
from .ground_truth import Rows, row_count
from .history import PastAction

if TYPE_CHECKING:  # annotations only: listing the tasks loads no simulator
    import newton
    from torch import Tensor

    from ..rendering.topdown import TopDown

__all__ = ["Action", "Layout", "Snapshot", "Stage", "Task"]

Action = np.ndarray
"""(7,) float64: pick x, y [m], yaw [rad], place x, y [m], yaw [rad], lift [m]."""


@dataclass(frozen=True, eq=False)
class Layout:
    """One sampled start of an episode.

    Attributes:
        particle_q: positions of the particles before settling (P, 3) [m]
        body_q: poses of the bodies before settling (B, 7), position [m] and quat_xyzw
        targets: what the task aims at; shape and meaning are the task's ((n, 2) points or a pose)
        zones: marks that are drawn
        pushes: perturbations that follow the start, at most `MOST_PUSHES`
        settle_seconds: how long the objects settle at least [s]
        calm: start by damping (speeds clamped for a moment) instead of falling freely; for layouts
            that are constructed at rest, such as goals
        frame: pose (3,) x, y [m], yaw [rad] in which the targets were laid out, where a task needs
            it
        configs: by their number, objects whose config differs from the task's in this episode: the
            colour of a bag, colour, size and mass of a body that is one box
        physics: of `warp_deform.xpbd.config.WORLD_PARAMETERS`, those that differ from the task's
        look: how pictures of this episode depart from the truth, where the task draws masks
    """

    particle_q: np.ndarray
    body_q: np.ndarray
    targets: np.ndarray
    zones: tuple[Zone, ...] = ()
    pushes: tuple[Push, ...] = ()
    settle_seconds: float = 0.0
    calm: bool = False
    frame: np.ndarray | None = None
    configs: Mapping[int, BagConfig | BoxConfig] = field(default_factory=dict)
    physics: Mapping[str, float] = field(default_factory=dict)
    look: MaskLook | None = None

    def with_targets(self, targets: np.ndarray) -> Layout:
        """The same start with other targets (a goal from elsewhere)."""
        return replace(self, targets=np.array(targets, dtype=float))


@dataclass(frozen=True, eq=False)
class Snapshot:
    """State of one world between two actions, as a rule at rest.

    `images` renders on first use.

    Attributes:
        particle_q: positions of the particles (P, 3) [m]
        particle_qd: velocities of the particles (P, 3) [m/s]
        body_q: poses of the bodies' frames (B, 7), position [m] and quat_xyzw
        body_qd: velocities of the bodies (B, 6), linear [m/s], angular [rad/s]
    """

    particle_q: np.ndarray
    particle_qd: np.ndarray
    body_q: np.ndarray
    body_qd: np.ndarray
    segments: tuple[range, ...]
    """Segmentation ids of zones and objects, in the order of `Task.drawn`."""
    render: Callable[[], Images] = field(repr=False)
    objects: tuple[SceneObject, ...] = ()
    """Where the objects of `Task.add_objects` stand in the arrays above, as they are here."""
    history: tuple[PastAction, ...] = ()
    """The episode's actions so far, and what came of each."""
    over: bool = False
    """Whether the episode had ended before its last action: what came after the end is no success.
    """

    @cached_property
    def actions(self) -> np.ndarray:
        """Actions of the episode so far (T, 7)."""
        return np.array([past.action for past in self.history]).reshape(-1, 7)

    @cached_property
    def points(self) -> np.ndarray:
        """Where particles and bodies are, seen from above (P + B, 2) [m]."""
        return np.concatenate([self.particle_q[:, :2], self.body_q[:, :2]])

    @cached_property
    def images(self) -> Images:
        """The three top-down views."""
        return self.render()


class Task(abc.ABC):
    """One task, of the benchmark or of your own; instances are stateless and reusable."""

    name: ClassVar[str]
    goal_conditioned: ClassVar[bool] = False
    max_actions: ClassVar[int] = 20
    stages: ClassVar[tuple[Stage, ...]]
    success_score: ClassVar[float]
    """Score at and above which the task is solved."""
    ground_truth_rows: ClassVar[Rows] = ()
    """What the numbers of the ground truth are, three a row, where it may be turned and mirrored
    with the table; without it no ground-truth baseline is trained with augmentation."""
    ground_truth_size: ClassVar[int]
    """Length of the ground truth; a class with `ground_truth_rows` of its own need not say it."""
    objects: ClassVar[tuple[str, ...]] = ()
    """Names of what is simulated, for listings."""
    solver: ClassVar[SolverConfig] = SolverConfig()
    """Parameters of the physics."""
    gradient_damping: ClassVar[float | None] = None
    """Damping [1/s] of the rollouts that actions are differentiated by; None: that of `solver`."""
    primitive: ClassVar[PrimitiveConfig] = PrimitiveConfig()
    """Speeds and heights of the robot's motion."""
    jaw: ClassVar[JawActionConfig | None] = None
    """A parallel jaw and its motion, where things are not taken by suction."""
    grid: ClassVar[PixelGrid] = TABLE_GRID
    """Which point of the table every pixel of an observation is."""
    rotated_copies: ClassVar[int | None] = None
    """Into how many turns of a circle augmentation turns a picture; None: by any angle."""
    mirrors: ClassVar[bool] = True
    """Whether mirror images of scenes and actions are the task's, too."""
    place_yaws: ClassVar[int] = 1
    """Place yaws to choose among, evenly spread; 1 where the yaw does not matter."""
    version: ClassVar[int] = 1
    """Of its Gymnasium id: rises with any change of physics, observation or reward."""
    instruction: ClassVar[str]
    """What is to be done, as a sentence for policies that read one; by default the name's words."""
    least_loss: ClassVar[float] = 0.0
    """What `loss` comes to when everything is done."""
    looks_aloft: ClassVar[bool] = False
    """Whether its rules ask where things were while what was held hung highest, see `Aloft`."""

    def __init_subclass__(cls, **options: object) -> None:
        super().__init_subclass__(**options)
        # who defines one of the two anew means it for both
        if "loss" in vars(cls) and "losses" not in vars(cls):
            cls.losses = Task.losses  # type: ignore[method-assign]
        if "losses" in vars(cls) and "loss" not in vars(cls):
            cls.loss = Task.loss  # type: ignore[method-assign]
        if "instruction" not in vars(cls) and isinstance(vars(cls).get("name"), str):
            cls.instruction = cls.name.replace("-", " ").capitalize() + "."
        if "ground_truth_rows" in vars(cls) and "ground_truth_size" not in vars(cls):
            cls.ground_truth_size = 3 * row_count(cls.ground_truth_rows)

    def stage_of(self, lift: float) -> Stage:
        """The stage whose lift is nearest to `lift` [m]; of equally near ones the first."""
        return min(self.stages, key=lambda stage: abs(stage.lift - lift))

    def privileged_stage(self, segment: int, snapshot: Snapshot, previous: Stage | None) -> Stage:
        """Stage of a pick on what has the segmentation id `segment`, by the paper's hidden rule.

        A task with one stage needs no rule; one with several states its own here.

        Args:
            snapshot: the state before the action
            previous: the episode's stage before, None at first
        """
        if len(self.stages) > 1:
            raise TypeError(f"{self.name} has {len(self.stages)} stages and no rule between them")
        return self.stages[0]

    @abc.abstractmethod
    def add_objects(self, builder: newton.ModelBuilder) -> tuple[SceneObject, ...]:
        """Add one world's objects to `builder`, in any pose; every seed has the same ones."""

    @abc.abstractmethod
    def sample(self, rng: np.random.Generator, space: FreeSpace) -> Layout:
        """Draw a start. `space` is an empty table and knows the robot's reach."""

    def sample_for_goal(
        self, rng: np.random.Generator, space: FreeSpace, targets: np.ndarray
    ) -> Layout:
        """Draw a start for a goal from elsewhere, whose `goal_targets` are `targets`."""
        return self.sample(rng, space).with_targets(targets)

    def drawn(
        self, layout: Layout, objects: tuple[SceneObject, ...]
    ) -> tuple[SceneObject | Zone, ...]:
        """What is drawn, in creation order: zones first, as in the original."""
        return (*layout.zones, *objects)

    def draw(
        self,
        topdown: TopDown,
        layout: Layout,
        drawables: Drawables,
        particle_q: np.ndarray,
        body_q: np.ndarray,
    ) -> Images:
        """What an observation shows of a state: the pictures of a top-down camera over `grid`."""
        return topdown.render(drawables, particle_q, body_q)

    def pick_yaw(self, color: np.ndarray, xy: np.ndarray) -> float:
        """Yaw [rad] at which to pick at `xy` (2,) [m], by the picture; for suction any will do."""
        return 0.0

    @abc.abstractmethod
    def score(self, layout: Layout, snapshot: Snapshot) -> float:
        """Progress in [0, 1]; the paper's partial score."""

    def solved(self, layout: Layout, snapshot: Snapshot) -> bool:
        """Whether the task is done."""
        return self.score(layout, snapshot) >= self.success_score

    def ended(self, layout: Layout, snapshot: Snapshot) -> bool:
        """Whether the last action ended the episode, solved or not."""
        return self.solved(layout, snapshot)

    def enclosed(self, layout: Layout, snapshot: Snapshot) -> bool | None:
        """Whether every item is where a bag keeps it; None for tasks without a bag or an item.

        Scores do not ask for it: it stands beside success.
        """
        return None

    def acceptable(self, layout: Layout, snapshot: Snapshot) -> bool:
        """Whether an episode may start like this, once settled; others are drawn again, counted."""
        return not self.solved(layout, snapshot)

    @abc.abstractmethod
    def demonstrate(
        self, layout: Layout, snapshot: Snapshot, rng: np.random.Generator
    ) -> Action | None:
        """The scripted demonstrator's next action, or None when it sees nothing to do."""

    def demonstrate_visible(
        self, layout: Layout, snapshot: Snapshot, rng: np.random.Generator
    ) -> Action | None:
        """The same by the visible demonstrator, which picks only what the tip would really meet."""
        return self.demonstrate(layout, snapshot, rng)

    def candidates(
        self, layout: Layout, snapshot: Snapshot, rng: np.random.Generator, count: int
    ) -> list[Action]:
        """Up to `count` actions that are worth simulating, for the `mpc` demonstrator."""
        drawn = [self.demonstrate_visible(layout, snapshot, rng) for _ in range(count)]
        return [action for action in drawn if action is not None]

    def state_value(self, layout: Layout, snapshot: Snapshot) -> float:
        """How good a state is to go on from; `mpc` takes the action whose outcome has the most."""
        return self.score(layout, snapshot)

    def measures(self, layout: Layout, snapshot: Snapshot) -> dict[str, float]:
        """What else is told of a state beside its score, by name; nothing depends on it."""
        return {}

    @classmethod
    def has_loss(cls) -> bool:
        """Whether the task defines `loss` or `losses`."""
        return cls.loss is not Task.loss or cls.losses is not Task.losses

    def loss(
        self, layout: Layout, snapshot: Snapshot, particle_q: Tensor, body_q: Tensor
    ) -> Tensor:
        """A smooth measure () of what is left to do after an action from `snapshot`.

        Only for tasks that define it, or `losses`, are there gradients to plan by, and dense
        rewards.

        Args:
            particle_q: positions of the particles that the action leaves (P, 3) [m]
            body_q: poses of the bodies that it leaves (B, 7)
        """
        if type(self).losses is Task.losses:
            raise TypeError(f"{self.name} has no loss to differentiate")
        return self.losses([layout], [snapshot], particle_q[None], body_q[None])[0]

    def losses(
        self,
        layouts: Sequence[Layout],
        snapshots: Sequence[Snapshot],
        particle_q: Tensor,
        body_q: Tensor,
    ) -> Tensor:
        """`loss` of many worlds (W,) at once, each to the bits that it has alone.

        A task defines one of the two, the other follows; this one costs less for many worlds.

        Args:
            layouts: of each world, as are `snapshots`
            particle_q: (W, P, 3) [m]
            body_q: (W, B, 7)
        """
        if type(self).loss is Task.loss:
            raise TypeError(f"{self.name} has no loss to differentiate")
        worlds = zip(layouts, snapshots, particle_q, body_q, strict=True)
        import torch

        return torch.stack([self.loss(*world) for world in worlds])

    def remaining(
        self,
        layouts: Sequence[Layout],
        snapshots: Sequence[Snapshot],
        particle_q: Tensor,
        body_q: Tensor,
    ) -> Tensor:
        """What rewards count down (W,): the losses above their least value, so about 0 when done.

        Args:
            snapshots: of the same states as `particle_q` (W, P, 3) and `body_q` (W, B, 7)
        """
        return self.losses(layouts, snapshots, particle_q, body_q) - self.least_loss

    @abc.abstractmethod
    def ground_truth(self, layout: Layout, snapshot: Snapshot) -> np.ndarray:
        """State vector (ground_truth_size,) float32 of the paper's ground-truth baselines."""

    def goal_layout(self, layout: Layout) -> Layout:
        """Layout with the objects placed at the targets; only for goal-conditioned tasks."""
        raise TypeError(f"{self.name} has no goal")

    def goal_shows_its_start(self) -> bool:
        """Whether a goal picture also shows things as they lay in the start that it is made of.

        In a start that is drawn for the goal they lie elsewhere, as in tests. Then validation plays
        for goals of other starts, and what is learnt with the goal of its own start is refused.
        """
        return False

    def goal_targets(self, layout: Layout, snapshot: Snapshot) -> np.ndarray:
        """Targets that a state stands for as a goal; only for goal-conditioned tasks."""
        raise TypeError(f"{self.name} has no goal")
