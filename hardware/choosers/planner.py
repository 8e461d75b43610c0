"""The chooser of the agent `planner`: estimate the chain, simulate actions, take the best.

It needs no demonstrations.

From the mask comes where the beads lie (`trace_strand`). A simulated chain is laid there, and
the candidates of the task `cable-mask-goal`, and others around the best, are tried. What counts is
the overlap with the goal's mask, the distance of the beads from where that mask puts them, and that
the chain is not bent otherwise than there. Where strands cross the estimate is a guess, so the best
action is done and everything estimated anew from the next picture.

Source: model predictive control, receding horizon; the search is `warp_deform.planning`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warp_deform.episodes import Goal
from warp_deform.errors import InputError
from warp_deform.objects.cable import CableConfig
from warp_deform.planning import SearchConfig, search
from warp_deform.planning.lookahead import Lookahead
from warp_deform.tasks.cable_mask_goal import CableMaskGoal
from warp_deform.tasks.free_space import FreeSpace
from warp_deform.tasks.metrics import chord_error, mask_iou
from warp_deform.tasks.strand_trace import trace_strand
from warp_deform.tasks.task import Layout, Snapshot
from warp_deform.worlds.worlds import Worlds

from ..arm.pick_place import PickPlaceAction
from ..episodes.episode import Observation
from ..vision.top_down_view import TopDownView
from .simple import FailedPicks, to_action

__all__ = ["PlannerChooser", "PlannerConfig", "SeenChain"]

_LANES = 8
_CHORD_LINKS = 15
"""Links that a chord bridges: 75 mm, more than a kink."""
_RISE = 0.6
"""Of a strand that comes to lie on another, in radii a bead."""


@dataclass(frozen=True, kw_only=True)
class PlannerConfig:
    """How hard to search."""

    budget: int = 32
    """Simulated actions for each real one; 16 take some 5 s on one core."""
    method: str = "cem"
    """See `warp_deform.planning`."""
    depth: int = 1
    """Actions ahead; two need twice the budget or more to be of use."""


class SeenChain(CableMaskGoal):
    """The task with one start, the seen one, and a goal that is a mask."""

    randomised = False

    def __init__(self, goal: np.ndarray, view: TopDownView | None = None) -> None:
        self._goal = goal
        self.grid = (view or TopDownView()).grid  # type: ignore[misc]  # one task for each workspace
        self.start = np.zeros((self.cable.beads, 3))

    def sample(self, rng: np.random.Generator, space: FreeSpace) -> Layout:
        """The seen chain, at rest."""
        none = np.zeros((0, 7))
        return Layout(self.start, none, np.zeros((0, 2)), settle_seconds=0.3, calm=True)

    def acceptable(self, layout: Layout, snapshot: Snapshot) -> bool:
        """Whatever is seen."""
        return True

    def score(self, layout: Layout, snapshot: Snapshot) -> float:
        """Overlap with the goal's own mask."""
        return mask_iou(self.mask(snapshot.particle_q), self._goal)

    def state_value(self, layout: Layout, snapshot: Snapshot) -> float:
        """Score, less the mean distance from the targets and the `chord_error`, the better way.

        Without the second of them moves that push the chain together look as good as others; it
        then kinks and crosses itself, and the next masks no longer show how it lies.
        """
        q, cable = snapshot.particle_q[:, :2], self.cable
        costs = [
            np.linalg.norm(q - targets, axis=1).mean() / cable.length
            + chord_error(q, targets, links=_CHORD_LINKS, spacing=cable.spacing)
            for targets in (layout.targets, layout.targets[::-1])
        ]
        return self.score(layout, snapshot) - float(min(costs))


class PlannerChooser:
    """Plans in simulation from what a mask shows.

    Args:
        seed: of the search's draws
        view: the workspace
        config: how hard to search
    """

    name = "planner"

    def __init__(
        self, *, seed: int = 0, view: TopDownView | None = None, config: PlannerConfig | None = None
    ) -> None:
        self._view = view or TopDownView()
        self._seed, self._config = seed, config or PlannerConfig()
        self._goal: np.ndarray | None = None
        self.reset()

    def reset(self) -> None:
        """Forget what was missed."""
        self._failed_picks = FailedPicks()
        self._ranked: list[PickPlaceAction] = []
        self._index = -1

    def choose(self, seen: Observation) -> PickPlaceAction | None:
        """See `Chooser.choose`.

        Raises:
            InputError: there is no goal, or its mask shows no chain
        """
        if seen.goal is None:
            raise InputError("the planner needs a goal; give --goal")
        if seen.index != self._index:
            self._index, self._ranked = seen.index, self._search(seen)
        for action in self._ranked:
            if not self._failed_picks.includes(seen, action):
                self._failed_picks.chose(action)
                return action
        return None

    def _search(self, seen: Observation) -> list[PickPlaceAction]:
        """Actions, the best first."""
        assert seen.goal is not None
        self._prepare(seen.goal)
        task = self._task
        traced = trace_strand(seen.mask, task.cable.beads)
        if traced is None:
            return []
        task.start = stacked(self._view.pixel_to_base(traced), task.cable)
        self._worlds.reset({0: seen.index}, goals={0: self._aim})
        rng = np.random.default_rng([self._seed, seen.index])
        config = SearchConfig(
            method=self._config.method, budget=self._config.budget, depth=self._config.depth
        )
        outlooks = search(self._lookahead, task, self._worlds.state(0), rng, config)
        return [to_action(outlook.action) for outlook in outlooks]

    def _prepare(self, goal: np.ndarray) -> None:
        """Worlds for a goal; made once."""
        if self._goal is not None and np.array_equal(goal, self._goal):
            return
        task = SeenChain(goal, self._view)
        traced = trace_strand(goal, task.cable.beads)
        if traced is None:
            raise InputError("the goal's mask shows no chain; capture it again")
        self._goal, self._task = goal, task
        self._aim = Goal(
            np.repeat(np.where(goal, 255, 0).astype(np.uint8)[..., None], 3, axis=2),
            np.zeros(goal.shape, np.float32),
            self._view.pixel_to_base(traced),
            kind="demonstrated",
            seed=0,
        )
        self._worlds = Worlds(task, 1, robot="panda", lanes=_LANES)
        self._lookahead = Lookahead(task, robot="panda", precision="float32", count=2 * _LANES)


def stacked(xy: np.ndarray, cable: CableConfig) -> np.ndarray:
    """Return beads (n, 3) [m] at x, y [m] (n, 2) on the ground, later strands over earlier ones.

    Which strand lies on top is not seen; some order there must be, or beads would overlap.
    """
    beads = np.column_stack([xy, np.full(len(xy), cable.radius)])
    apart = np.linalg.norm(xy[:, None] - xy[None], axis=-1)
    index = np.arange(len(xy))
    for i in range(len(xy)):
        under = (apart[i] < 2.2 * cable.radius) & (index < i - 6)
        if under.any():
            beads[i, 2] = beads[under, 2].max() + 2.0 * cable.radius
    # a strand rises over a few beads, not from one to the next
    slope = _RISE * cable.radius * np.abs(index[:, None] - index)
    beads[:, 2] = (beads[:, 2] - slope).max(axis=1)
    return beads
