"""Agents learn one demonstration by heart, through the whole of `train`.

What a traced one learns, of cables alone, is in `models/test_traced.py`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fixtures.training_samples import block_episode, write_demonstrations

from learning.policy.policy import load_policy
from learning.runs.folder import RunFolder
from learning.training.config import TrainConfig
from learning.training.schedules import Schedule
from learning.training.train import train
from warp_deform.episodes import Episode

PICTURES = Schedule(steps=30, batch=1, lr=5e-4, warmup=5, decay=True, snapshots=1)
GOALS = Schedule(steps=12, batch=1, lr=1e-3, warmup=3, snapshots=1)
STATES = Schedule(steps=500, batch=1, lr=3e-3, warmup=50, decay=True, snapshots=1)
AGENTS = {
    "transporter": ("cable-ring", PICTURES),
    "goal-split": ("cable-line-notarget", GOALS),
    "goal-stack": ("cable-line-notarget", GOALS),
    "gt-mlp": ("cable-line-notarget", STATES),
    "gt-mlp-2step": ("cable-line-notarget", STATES),
}
NEAR, FAR = 0.01, 0.03
"""What counts as the demonstrated point, and what as another one [m]."""


@pytest.mark.parametrize("agent", AGENTS)
def test_one_demonstration_is_learned_by_heart(agent: str, tmp_path: Path) -> None:
    task, schedule = AGENTS[agent]
    data = write_demonstrations(tmp_path / "data", 1, task=task, actions=1)
    train(
        TrainConfig(
            task=task,
            agent=agent,
            data=data,
            out=tmp_path / "run",
            preset="fast",
            schedule=schedule,
            augment=False,
            untrained=True,
        )
    )
    before, after = (
        distance(tmp_path / "run", step, block_episode(0, task=task, actions=1))
        for step in (0, schedule.steps)
    )
    assert after < NEAR
    assert before > FAR


def distance(run: Path, step: int, episode: Episode) -> float:
    """The greater distance [m] of pick and place from the demonstrated ones."""
    policy = load_policy(RunFolder(run).snapshot(step))
    first, last = episode.steps[0], episode.steps[-1]
    truth = first.ground_truth.copy()
    if episode.goal is not None:  # hindsight, as in training
        half = len(truth) // 2
        truth[half:] = last.ground_truth[:half]
    seen = {
        "color": first.color,
        "height": first.height,
        "goal_color": last.color,
        "goal_height": last.height,
        "ground_truth": truth,
    }
    action = policy.act(seen, rng=np.random.default_rng(0))
    gap = action - first.action
    return max(float(np.hypot(*gap[:2])), float(np.hypot(*gap[3:5])))
