"""What keeps 2-Step from placing the block: demonstrations, or steps of its place network.

    python benchmarks/place_network.py [--demos N...] [--lr LR...] [--exact] [--out FILE]

Nothing is simulated. Scenes are drawn like the task's, a pick lies anywhere on the L, and where to
place it follows from the goal's pose. 2-Step is trained on N such scenes, moved like
demonstrations, and its place network alone is tested: it places what was picked in scenes that it
never saw. A peer in the same run, GT-State MLP, chooses pick and place at once.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import torch

from learning.data.augmentation import draw_transforms, move_actions, move_states
from learning.models.adam import KerasAdam
from learning.models.gt_state import GtState, GtState2Step, GtStateConfig, encode_action
from learning.training.schedules import STATE_SCHEDULES
from warp_deform.support.revision import running_revision
from warp_deform.tasks.ground_truth import YAW_SCALE, yaw_columns
from warp_deform.tasks.registry import task

TASK = task("block-notarget")
ARMS = np.array([[0.025, 0.0], [0.0, 0.025]])
"""Middles of the L's two arms [m] from the block's origin, 8 by 3 and 3 by 8 cm."""
HALVES = np.array([[0.04, 0.015], [0.015, 0.04]])
NEAR, ALIKE = 0.01, np.deg2rad(15)
"""What the task calls solved [m], [rad]."""
TESTS = 2000


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--demos", nargs="+", type=int, default=(100, 1000))
    parser.add_argument("--lr", nargs="+", type=float, default=(2e-4, 1e-3))
    parser.add_argument("--steps", type=int, default=STATE_SCHEDULES["fast"].steps)
    parser.add_argument("--exact", action="store_true", help="by the original's likelihood")
    parser.add_argument("--out", type=Path, help="JSON lines, appended to")
    options = parser.parse_args()
    for demos in options.demos:
        for lr in options.lr:
            for name in ("gt-mlp-2step", "gt-mlp"):
                row = measure(name, demos, lr, options.steps, exact=options.exact)
                print(row, flush=True)
                if options.out is not None:
                    with options.out.open("a") as file:
                        file.write(json.dumps(row | {"commit": running_revision().commit}) + "\n")


def scenes(n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """States (n, 6) float32 of block and goal, and actions (n, 7) that carry one to the other."""
    start, goal = rng.uniform([0.32, -0.43, -np.pi], [0.68, 0.43, np.pi], (2, n, 3))
    arm = rng.integers(2, size=n)
    offset = ARMS[arm] + rng.uniform(-1, 1, (n, 2)) * HALVES[arm]
    pick = start[:, :2] + turned(offset, start[:, 2])
    place = goal[:, :2] + turned(offset, goal[:, 2])
    turn = wrapped(goal[:, 2] - start[:, 2])
    actions = np.column_stack([pick, 0 * turn, place, turn, np.full(n, TASK.stages[0].lift)])
    units = [1.0, 1.0, -1.0 / YAW_SCALE]
    return np.hstack([start * units, goal * units]).astype(np.float32), actions


def measure(name: str, demos: int, lr: float, steps: int, *, exact: bool) -> dict[str, object]:
    """Train one network on `demos` scenes, and count the places that solve new ones."""
    torch.set_num_threads(1)
    rng = np.random.default_rng(0)
    config = GtStateConfig(
        one_rotation=False, yaws=yaw_columns(TASK.ground_truth_rows), exact=exact
    )
    agent = (GtState2Step if name == "gt-mlp-2step" else GtState)(6, config, seed=0)
    states, actions = scenes(demos, rng)
    optimizer = KerasAdam(agent.parameters(), lr=lr)
    lift = torch.zeros(128, dtype=torch.int64)
    for step in range(steps):
        drawn = rng.integers(demos, size=128)
        moves = draw_transforms(actions[drawn], rng=rng, grid=TASK.grid, in_view=False)
        state = move_states(TASK.ground_truth_rows, states[drawn], moves)
        target = encode_action(move_actions(actions[drawn], moves))
        optimizer.param_groups[0]["lr"] = lr * 0.5 * (1 + np.cos(np.pi * step / steps))
        optimizer.zero_grad()
        agent(torch.from_numpy(state), torch.from_numpy(target), lift).total().backward()
        optimizer.step()
    state, truth = scenes(TESTS, np.random.default_rng(1))
    solved = placed(agent, state, truth, rng=rng)
    return {
        "agent": name,
        "demos": demos,
        "lr": lr,
        "steps": steps,
        "exact": exact,
        "n_success": int(solved.sum()),
        "n_episodes": TESTS,
    }


def placed(
    agent: GtState | GtState2Step, state: np.ndarray, truth: np.ndarray, *, rng: np.random.Generator
) -> np.ndarray:
    """Whether one action would solve each scene.

    2-Step's place network is handed a true pick, so that it is tested alone. GT-State MLP's place
    goes with its own pick, and a pick beside the block is a failure.
    """
    action = agent.act(torch.from_numpy(state), rng=rng)
    if isinstance(agent, GtState2Step):
        action = truth.copy()
        given = torch.from_numpy(np.hstack([state, encode_action(truth)[:, :3]]))
        mixture = agent.place(given)
        best = mixture.log_pi.argmax(dim=1)
        place = mixture.mean[torch.arange(len(best)), best].detach().numpy()
        action[:, 3:6] = place / [1.0, 1.0, -1.0 / YAW_SCALE]
    start, goal = state[:, :3].astype(float), state[:, 3:].astype(float)
    yaw, wanted = -YAW_SCALE * start[:, 2], -YAW_SCALE * goal[:, 2]
    turn = action[:, 5] - action[:, 2]
    offset = action[:, :2] - start[:, :2]
    end = action[:, 3:5] - turned(offset, turn)
    on = (np.abs(turned(offset, -yaw)[:, None] - ARMS) <= HALVES + 1e-9).all(axis=2).any(axis=1)
    near = np.linalg.norm(end - goal[:, :2], axis=1) < NEAR
    return on & near & (np.abs(wrapped(yaw + turn - wanted)) < ALIKE)


def turned(points: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Points (n, 2), each turned by an angle (n,) [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1]], 1)


def wrapped(angle: np.ndarray) -> np.ndarray:
    """Angles [rad] within half a turn."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


if __name__ == "__main__":
    main()
