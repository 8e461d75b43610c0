"""From demonstrations to what the networks learn from: pictures or states with their labels."""

from __future__ import annotations

import functools
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from warp_deform.errors import InputError
from warp_deform.rendering.pixels import SHAPE
from warp_deform.tasks.strand_trace import trace_strand
from warp_deform.tasks.task import Task

from ..models.batch import Batch
from ..models.cable_model import (
    WAYS,
    moved_points,
    same_way,
    seen_moves,
    turned_over,
    turned_over_points,
)
from ..models.gt_state import GtState, GtState2Step, encode_action
from ..models.traced import LEVEL, Traced, TracedBatch, TracedConfig
from ..models.transporter import Transporter
from .augmentation import draw_transform, draw_transforms, move_actions, move_picture, move_states
from .dataset import Demonstrations

__all__ = [
    "StateBatch",
    "agent_batch",
    "check_lifts",
    "check_traces",
    "check_view",
    "image_batch",
    "state_batch",
    "task_lifts",
    "traced_batch",
]

_LIFT_GAP = 0.015
"""Lifts of one stage may differ by this [m]: a robot lifts 1 cm less to carry over short ways."""

_TRACES = 50_000
"""States of which the traced cable is kept, 1 kB each."""

StateBatch = tuple[Tensor, Tensor, Tensor]
"""States (B, D), encoded actions (B, 6), lift indices (B,)."""


def task_lifts(task: Task) -> tuple[float, ...]:
    """Lifts of the task's stages [m], each once, from low to high.

    Examples:
        >>> from warp_deform.tasks.registry import task
        >>> task_lifts(task("bag-items-1"))
        (0.05, 0.3, 0.4)
    """
    return tuple(sorted({stage.lift for stage in task.stages}))


def check_lifts(data: Demonstrations) -> None:
    """See that every action's lift is that of a stage of the task.

    Raises:
        InputError: one is not.
    """
    lifts = task_lifts(data.task)
    for name, actions in data.actions():
        for action in actions:
            _lift_index(action, lifts, what=name)


def check_view(data: Demonstrations) -> None:
    """See that every pick and place is in view.

    Raises:
        InputError: one is not.
    """
    for name, actions in data.actions():
        for action in actions:
            pixels = data.task.grid.to_pixel(np.stack([action[:2], action[3:5]]))
            _check_pixels(pixels, action, what=name)


def agent_batch(
    data: Demonstrations,
    agent: Transporter | Traced | GtState | GtState2Step,
    *,
    transitions: Iterable[tuple[int, int]],
    rng: np.random.Generator,
    augment: bool = True,
    mirror: bool = False,
    device: torch.device,
) -> tuple[Any, ...]:
    """Arguments of an agent's losses: transitions as it sees them, moved by `rng`.

    Raises:
        InputError: as of the batches below.
    """
    if isinstance(agent, Transporter):
        batch = image_batch(
            data, agent, transitions=transitions, rng=rng, augment=augment, mirror=mirror
        )
        return (batch._replace(image=batch.image.to(device)),)
    if isinstance(agent, Traced):
        traced = traced_batch(data, agent, transitions=transitions, rng=rng, augment=augment)
        return (TracedBatch(*(each.to(device) for each in traced)),)
    tensors = state_batch(
        data, agent.config.lifts, transitions=transitions, rng=rng, augment=augment
    )
    return tuple(each.to(device) for each in tensors)


def image_batch(
    data: Demonstrations,
    agent: Transporter,
    *,
    transitions: Iterable[tuple[int, int]],
    rng: np.random.Generator,
    augment: bool = True,
    mirror: bool = False,
) -> Batch:
    """Transitions, moved by `rng`, as an agent over pictures sees them.

    Args:
        transitions: number of a demonstration, and of an action in it, as of `Demonstrations.drawn`
        mirror: show every second one mirrored, where mirror images are scenes of the task

    Raises:
        InputError: a pick or place is out of view, or a lift is no stage's.
    """
    images, picks, places, thetas, lifts = [], [], [], [], []
    grid, copies, mirrors = data.task.grid, data.task.rotated_copies, data.task.mirrors
    for transition in (data.transition(*each) for each in transitions):
        pictures = [(transition.color, transition.height)]
        if agent.pictures == 2:
            pictures.append((transition.goal_color, transition.goal_height))
        pixels = grid.to_pixel(np.stack([transition.action[:2], transition.action[3:5]]))
        turn = transition.action[2] - transition.action[5]
        if augment:
            moved = draw_transform(
                transition.action, rng=rng, grid=grid, copies=copies, mirror=mirror and mirrors
            )
            turn *= moved.handed
            pictures = [move_picture(*picture, moved) for picture in pictures]
            pixels = np.round(moved.of_pixels(pixels)).astype(np.int64)
        _check_pixels(pixels, transition.action)
        images.append(agent.image(*pictures))
        pick, place = agent.config.to_network(pixels)
        picks.append(pick)
        places.append(place)
        thetas.append(turn)
        lifts.append(_lift_index(transition.action, agent.config.lifts))
    return Batch(
        torch.stack(images),
        torch.from_numpy(np.stack(picks)),
        torch.from_numpy(np.stack(places)),
        torch.tensor(thetas, dtype=torch.float32),
        torch.tensor(lifts),
    )


def traced_batch(
    data: Demonstrations,
    agent: Traced,
    *,
    transitions: Iterable[tuple[int, int]],
    rng: np.random.Generator,
    augment: bool = True,
) -> TracedBatch:
    """What was carried and where it led, mirrored and read from either end by `rng`.

    Args:
        data: `as_played`

    Raises:
        InputError: a mask shows no cable.
    """
    moves = [_traced_move(data, agent.config, *each) for each in transitions]
    now, after, picks, places = (np.stack(each) for each in zip(*moves, strict=True))
    seen = torch.from_numpy(seen_moves(now, picks, places))
    moved = torch.from_numpy(moved_points(now, after, picks, places))
    if augment:
        ways = [WAYS[int(k)] for k in rng.integers(len(WAYS), size=len(moves))]
        shown = [turned_over(seen[k : k + 1], *way) for k, way in enumerate(ways)]
        went = [turned_over_points(moved[k : k + 1], *way) for k, way in enumerate(ways)]
        seen, moved = torch.cat(shown), torch.cat(went)
    return TracedBatch(seen, moved)


def check_traces(data: Demonstrations, config: TracedConfig) -> None:
    """Trace the cable of every state.

    Raises:
        InputError: a mask shows none.
    """
    for episode, length in enumerate(data.lengths()):
        for t in range(length + 1):
            _traced(data, config.points, episode, t)


def _traced_move(
    data: Demonstrations, config: TracedConfig, episode: int, t: int
) -> tuple[np.ndarray, ...]:
    """The cable before and after an action (points, 2), its pick and its place (2,), all [px]."""
    now, after = (_traced(data, config.points, episode, k) for k in (t, t + 1))
    action, grid = data.action(episode, t), data.task.grid
    pick, place = grid.fractional(action[:2]), grid.fractional(action[3:5])
    return now, same_way(now, after, pick, place), pick, place


@functools.lru_cache(maxsize=_TRACES)
def _traced(data: Demonstrations, points: int, episode: int, t: int) -> np.ndarray:
    """The cable of a state (points, 2) [px]; tracing takes longer than learning."""
    line = trace_strand(data.color(episode, t)[..., 0] > LEVEL, points)
    if line is None:
        raise InputError(
            f"episode {data.seeds[episode]} shows no cable after {t} actions; remove its file"
        )
    return line


def state_batch(
    data: Demonstrations,
    lifts: tuple[float, ...],
    *,
    transitions: Iterable[tuple[int, int]],
    rng: np.random.Generator,
    augment: bool = True,
) -> StateBatch:
    """Transitions, moved by `rng`, as a ground-truth baseline sees them; see `image_batch`.

    Raises:
        InputError: a lift is no stage's.
    """
    grid, copies = data.task.grid, data.task.rotated_copies
    pairs = [data.state(*each) for each in transitions]
    states, actions = (np.stack(each) for each in zip(*pairs, strict=True))
    if augment:
        # A state has no edges to leave. Seita et al. let labels leave the table here too: keeping
        # them would show few turns where pick and place are far apart.
        transforms = draw_transforms(actions, rng=rng, grid=grid, copies=copies, in_view=False)
        states = move_states(data.task.ground_truth_rows, states, transforms)
        actions = move_actions(actions, transforms)
    indices = torch.tensor([_lift_index(action, lifts) for action in actions])
    return torch.from_numpy(states), torch.from_numpy(encode_action(actions)), indices


def _check_pixels(pixels: np.ndarray, action: np.ndarray, *, what: str = "a demonstration") -> None:
    if not ((pixels >= 0) & (pixels < SHAPE)).all():
        raise InputError(f"{what} acts out of view, at {action.tolist()}")


def _lift_index(
    action: np.ndarray, lifts: tuple[float, ...], *, what: str = "a demonstration"
) -> int:
    gaps = np.abs(np.array(lifts) - action[6])
    if not gaps.min() <= _LIFT_GAP:  # or it is not a number
        stages = ", ".join(f"{lift:g}" for lift in lifts)
        raise InputError(
            f"{what} lifts to {action[6]:g} m; the task's stages lift to {stages} m, and an agent "
            "learns these alone"
        )
    return int(gaps.argmin())
