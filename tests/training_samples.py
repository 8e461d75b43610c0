"""Synthetic demonstrations at the camera's size, for the tests of learning."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from episode_samples import make_episode, with_info

from warp_deform.episodes import Episode, EpisodeWriter
from warp_deform.rendering.pixels import SHAPE, pixel_to_world
from warp_deform.tasks.registry import task as find_task


def block_episode(seed: int, *, task: str = "cable-line-notarget", actions: int = 2) -> Episode:
    """A red square that every action carries on, and a ground truth of the task's size.

    The square is picked at its middle, so an agent can learn where to pick from the picture.
    """
    rng = np.random.default_rng(seed)
    middles = rng.integers([60, 40], [260, 120], size=(actions + 1, 2))
    made = make_episode(seed, actions=actions, size=SHAPE, goal=task.endswith("notarget"))
    lift = find_task(task).stages[0].lift
    steps = []
    for t, step in enumerate(made.steps):
        row, column = middles[t]
        color = np.full((*SHAPE, 3), 40, np.uint8)
        color[row - 8 : row + 8, column - 8 : column + 8] = (220, 30, 30)
        height = np.zeros(SHAPE, np.float32)
        height[row - 8 : row + 8, column - 8 : column + 8] = 0.02
        action = None
        if t < actions:
            pick, place = pixel_to_world(middles[t]), pixel_to_world(middles[t + 1])
            action = np.array([*pick, 0.0, *place, 0.0, lift])
        truth = np.zeros(find_task(task).ground_truth_size, np.float32)
        truth[:2] = pixel_to_world(middles[t])
        steps.append(
            dataclasses.replace(step, color=color, height=height, action=action, ground_truth=truth)
        )
    return with_info(dataclasses.replace(made, steps=tuple(steps)), task=task)


def write_demonstrations(
    folder: Path, count: int = 3, *, task: str = "cable-line-notarget", actions: int = 2
) -> Path:
    """A folder of so many demonstrations, of seeds 0 and up."""
    writer = EpisodeWriter(folder)
    for seed in range(count):
        writer.write(block_episode(seed, task=task, actions=actions))
    return folder
