"""`SwingProblem`: many plans for goals of swings, side by side in lanes of one simulator."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from ..rollout.differentiable import DifferentiableRollout
from ..rollout.rollouts import GripPath, rollout
from .control_task import ControlTask
from .control_worlds import ControlWorlds
from .modes import TipTargets
from .plan_problem import in_parts
from .smooth_plans import KNOTS, actions_of, numbers_of, tensor_actions_of

if TYPE_CHECKING:
    from torch import Tensor

__all__: list[str] = []  # `warp_deform.control` is the import path of what is here

_LANES = 8


class SwingProblem:
    """Plans for the goals of seeds, of a task that holds a particle from the start.

    A plan's loss is the task's at the end of its steps, with the bits of the environment of the
    same seed under the same actions in the mode "tip_delta_position".

    Args:
        task: a name, or a `ControlTask` with a `held_particle`
        seeds: of the goals
        worlds: that run side by side, a multiple of 8
        robot: whose reach limits the tip

    Raises:
        InputError: the task holds nothing from the start, or has bodies; or there are no seeds, or
            `worlds` is no multiple of 8.
    """

    def __init__(
        self,
        task: str | ControlTask,
        seeds: Sequence[int],
        *,
        worlds: int = 64,
        robot: str = "ur5",
    ) -> None:
        if worlds < 1 or worlds % _LANES or not len(seeds):
            raise InputError(f"worlds must be a multiple of {_LANES}, and seeds one or more")
        self._control = ControlWorlds(task, worlds, robot=robot, lanes=_LANES)
        found = self._control.task
        if not isinstance(found, ControlTask) or found.held_particle is None:
            raise InputError(f"{found.name} holds nothing from the start, so it is no swing")
        if "box" in found.objects:
            raise InputError(
                f"{found.name} has bodies, which are not put back after a swing: search its plans "
                "with EpisodeProblem or HeldProblem"
            )
        self.task, self.seeds = found, [int(seed) for seed in seeds]
        self._solver = self._control.worlds.solver
        self.steps = self._control.horizon
        """Control steps T of a plan."""
        self._targets = TipTargets(
            "tip_delta_position", self._control.config, self._control.limits, worlds
        )
        states = []
        for first in range(0, len(self.seeds), worlds):
            states += self._starts(self.seeds[first : first + worlds])
        positions, velocities, floors, self.layouts = zip(*states, strict=True)
        self._floors = np.array(floors)
        self._knot_times = self._times()
        self._positions, self._velocities = np.stack(positions), np.stack(velocities)
        self._tips = np.pad(self._positions[:, self._held].astype(float), ((0, 0), (0, 1)))
        self._run: DifferentiableRollout | None = None

    def _starts(self, seeds: Sequence[int]) -> list[tuple[np.ndarray, np.ndarray, float, object]]:
        """Positions, velocities, lowest height of the tip and layout of every seed."""
        control = self._control
        control.reset(dict(enumerate(seeds)))
        control.tips.end()
        solver, episodes = self._solver, control.worlds.episodes
        return [
            (solver.particle_q(slot), solver.particle_qd(slot),
             float(control.targets.floors[slot]), episodes[slot].layout)
            for slot in range(len(seeds))
        ]  # fmt: skip

    def _times(self) -> np.ndarray:
        """Of the knots (T + 2,) [s], in the kernel's arithmetic; the last is never reached."""
        number, loop = self._solver.data.number, self._control.tips.loop
        ticks = loop.substeps * np.arange(self._control.horizon + 1)
        clock = ticks.astype(number) * number(self._solver.config.dt)
        return np.append(clock.astype(float), 1e6)

    @contextlib.contextmanager
    def begun_at(
        self, positions: np.ndarray, velocities: np.ndarray, tips: np.ndarray, *, steps: int
    ) -> Iterator[None]:
        """Within it plans begin at other states, and are so many steps long.

        Args:
            positions: of every goal's particles (G, P, 3) [m]
            velocities: of these (G, P, 3) [m/s]
            tips: where the tips were led last (G, 4), see `TipTargets.sent`
            steps: that are left of an episode, 1 or more

        Raises:
            InputError: another shape, or no such number of steps.
        """
        kept, before = (self._positions, self._velocities, self._tips), self.steps
        for name, given, own in zip(
            ("positions", "velocities", "tips"), (positions, velocities, tips), kept, strict=True
        ):
            if np.shape(given) != own.shape:
                raise InputError(f"{name} must have the shape {own.shape}, not {np.shape(given)}")
        if not 1 <= steps <= self.horizon:
            raise InputError(f"steps must be 1 to {self.horizon}, not {steps}")
        self._positions, self._velocities = np.asarray(positions), np.asarray(velocities)
        self._tips = self._control.limits.asked(np.asarray(tips, dtype=float), self._floors)
        self.steps = steps
        try:
            yield
        finally:
            (self._positions, self._velocities, self._tips), self.steps = kept, before

    @property
    def goals(self) -> int:
        """Number of goals G."""
        return len(self.seeds)

    @property
    def shape(self) -> tuple[int, int]:
        """Of the free numbers of a plan."""
        return KNOTS, 3

    def actions(self, numbers: np.ndarray) -> np.ndarray:
        """Actions (..., T, 4) of the environment for plans (..., K, 3) of any number K."""
        moves = actions_of(numbers, self.steps)
        return np.concatenate([moves, np.ones((*moves.shape[:-1], 1))], axis=-1)

    def evaluate(self, numbers: np.ndarray) -> np.ndarray:
        """Losses (G, N) of plans (G, N, K, 3); inf where a guard fires."""
        goals, ends = self.run(numbers)
        return self._losses(goals, ends).reshape(numbers.shape[:2])

    def run(self, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Number of the goal (G N,) and particles (G N, P, 3) [m] at the end of every plan.

        Particles are not numbers where a guard fires.
        """
        actions = self.actions(numbers).reshape(-1, self.steps, 4)
        of = np.repeat(np.arange(len(numbers)), numbers.shape[1])
        room = self._control.worlds.count
        parts = [slice(first, first + room) for first in range(0, len(actions), room)]
        return of, np.concatenate([self._ends(of[part], actions[part]) for part in parts])

    def _ends(self, of: np.ndarray, actions: np.ndarray) -> np.ndarray:
        solver, worlds = self._solver, list(range(len(of)))
        steps = self._led(of, actions)
        self._put(of)
        seconds = self.steps * self._control.tips.loop.seconds
        paths = self._paths(of, steps)
        runs = rollout(solver, worlds, paths=paths, min_seconds=2 * seconds, max_seconds=seconds)
        ends = np.stack([solver.particle_q(w).astype(float) for w in worlds])
        limits = solver.config.limits
        wrong = [bool(runs[w].watch.problems(w, limits)) for w in worlds]
        ends[wrong] = np.nan
        return ends

    def _led(self, of: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Where the tips are told to be (T, n, 3) [m] at the ends of T steps."""
        worlds = list(range(len(of)))
        self._targets.floors[worlds] = self._floors[of]
        self._targets.place(worlds, self._tips[of])
        return self._targets.follow_steps(worlds, actions.swapaxes(0, 1))[..., :3]

    def _paths(self, of: np.ndarray, steps: np.ndarray) -> dict[int, GripPath]:
        """Of worlds whose tips are told to be (T, n, 3) [m] at the ends of T steps."""
        places = self._positions[of, self._held].astype(float)
        knots = np.stack([places, *steps, steps[-1]], axis=1)
        times = np.append(self._knot_times[: self.steps + 1], self._knot_times[-1])
        return {w: GripPath(times, k, particle=self._held) for w, k in enumerate(knots)}

    def _put(self, of: np.ndarray) -> None:
        """Put worlds to the starts of goals."""
        data = self._solver.data
        for w, goal in enumerate(of):
            data.lane("particles.x", w)[:] = self._positions[goal]
            data.lane("particles.v", w)[:] = self._velocities[goal]

    @property
    def _held(self) -> int:
        assert self.task.held_particle is not None, "it was looked at before"
        return self.task.held_particle

    @property
    def horizon(self) -> int:
        """Control steps of a whole episode."""
        return self._control.horizon

    @property
    def particles(self) -> int:
        """Their number P."""
        return self._positions.shape[1]

    def refined(self, numbers: np.ndarray) -> np.ndarray:
        """Numbers (G, T, 3), three a step, of the plans that have numbers (G, K, 3)."""
        return numbers_of(numbers, self.steps)

    def gradients(self, numbers: np.ndarray, goals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Losses (n,) of plans (n, K, 3) for these goals (n,), and their gradients (n, K, 3).

        The losses have the bits of `evaluate`. Where a guard fires they are inf, and the
        gradients mean nothing.
        """
        return in_parts(self._gradients, goals, numbers, self._control.worlds.count)

    def _gradients(self, of: np.ndarray, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A plan is one launch, forth and back: what is led through N steps has the same bits."""
        import torch

        worlds, steps = list(range(len(of))), self._led(of, self.actions(numbers))
        self._put(of)
        run = self._run = self._run or DifferentiableRollout(self._solver)
        seconds = self.steps * self._control.tips.loop.seconds
        ends = run.forward(worlds, [seconds], paths=self._paths(of, steps))[:, -1]
        places = torch.from_numpy(ends.astype(float)).requires_grad_()
        with torch.enable_grad():
            losses = self._losses_of(of, places)
            (by_places,) = torch.autograd.grad(losses.sum(), places)
        ways = run.backward(by_places[:, None].numpy(), parts=False).waypoints
        by_ways = np.stack([ways[w] for w in worlds], axis=1)
        by_ways[-2] += by_ways[-1]  # the last target stands there twice
        free = torch.tensor(numbers, dtype=torch.float64, requires_grad=True)
        with torch.enable_grad():
            told = self._tensor_ways(of, tensor_actions_of(free, self.steps))
        (gradients,) = torch.autograd.grad(told, free, torch.from_numpy(by_ways[1:-1]))
        out = losses.detach().numpy().copy()
        limits = self._solver.config.limits
        out[[bool(run.watch[w].problems(w, limits)) for w in worlds]] = np.inf
        return np.where(np.isfinite(out), out, np.inf), gradients.numpy()

    def _tensor_ways(self, of: np.ndarray, moves: Tensor) -> Tensor:
        """Targets of the tips (T, n, 3) [m] for actions (n, T, 3), as `TipTargets` makes them."""
        import torch

        config, limits = self._control.config, self._control.limits
        floors = torch.from_numpy(self._floors[of])
        steps = torch.nn.functional.pad(moves, (0, 1)) * (config.max_speed * config.seconds)
        tips = torch.from_numpy(self._tips[of])
        asked = limits.remembered(tips, steps.swapaxes(0, 1), floors)
        return limits.project(asked, floors)[..., :3]

    def _losses(self, of: np.ndarray, ends: np.ndarray) -> np.ndarray:
        import torch

        with torch.no_grad():
            losses = self._losses_of(of, torch.from_numpy(ends)).numpy()
        return np.where(np.isfinite(losses), losses, np.inf)

    def _losses_of(self, of: np.ndarray, ends: Tensor) -> Tensor:
        """Losses (n,) of particles (n, P, 3) for goals."""
        bodies = ends.new_zeros((len(ends), 0, 7))
        return self.task.losses([self.layouts[goal] for goal in of], [], ends, bodies)
