"""What policies of control come to that APG, SHAC, PPO and plans train in equal CPU seconds.

    python benchmarks/control_policies.py [--tasks TASK...] [--methods METHOD...] [--seconds S]
                                          [--seeds SEED...] [--goals N] [--work DIR] [--out FILE]

All methods play 32 episodes side by side in one process on one thread, of the same 512 training
seeds, for the same reward: progress, less what presses against a limit costs. Only "plan" draws 64
of 2048, needs a swing, and acts open loop. The seconds are those of the process for acting,
simulating and learning; all but PPO plan their updates by what a few cost, so `cpu_s` is what they
took. Five snapshots, evenly spread, play 64 validation
goals; the best by its mean score is tested on goals from 10,000 on, which nothing was chosen on.
Validation and test are not counted. SHAC's settings were chosen on validation goals of whip-target,
in 36 s each; APG's are older, and were chosen on goals from 10,000 on too; PPO has its defaults but
for what stands in `by_ppo`.

Swings have their own 20 steps; cable-line-notarget is held from the start, with 60. "still" waits.
PPO is that of stable-baselines3, with a network as the others', and observations and rewards that
it normalises.

One row a task, method, seed and budget, appended when its test ends. Rows that are there are left
out, and a run of APG or SHAC that was interrupted goes on from its folder. Shares within 10, 5, 2
and 1 cm are counts of goals, so that intervals can be told; of whip and cable-line the distance is
the mean over the beads, of whip over sqrt(3), as DaXBench has it. Goals at which a guard fires
count as missed.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from torch import Tensor, nn

from learning.control.actor import pressed
from learning.control.apg import ApgConfig
from learning.control.evaluate import evaluate_control
from learning.control.play import PlayedControl, bootstrapped, play_control
from learning.control.train import ControlTrainConfig, train_control
from warp_deform.control import TensorControlWorlds
from warp_deform.quiet import quiet_warp

WORLDS, EPISODES, SNAPSHOTS, VALIDATE = 32, 512, 5, 64
PLANS = {"worlds": 64, "episodes": 2048}
HORIZON = {"cable-line-notarget": 60}
TASKS = ("whip-target", "whip", "cable-line-notarget")
METHODS = ("still", "apg", "shac", "plan", "ppo")
PRESS_PENALTY = ApgConfig.press_penalty


class Lanes(VecEnv):
    """Episodes of training seeds for stable-baselines3, without derivatives.

    Actions are the tip's moves, each number from -1 to 1; it keeps hold.
    """

    def __init__(self, worlds: TensorControlWorlds, *, seed: int) -> None:
        self.worlds, self._rng = worlds, np.random.default_rng([19, seed])
        self.count = worlds.worlds.count
        worlds.reset(self._draw(range(self.count)))
        size = worlds.observe().shape[1]
        seen = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)
        super().__init__(self.count, seen, gymnasium.spaces.Box(-1.0, 1.0, (3,), np.float32))

    def _draw(self, slots: Any) -> dict[int, int]:
        return {int(slot): int(self._rng.integers(EPISODES)) for slot in slots}

    def reset(self) -> np.ndarray:
        """Begin new episodes in all lanes."""
        self.worlds.reset(self._draw(range(self.count)))
        return self._seen()

    def _seen(self) -> np.ndarray:
        seen: np.ndarray = self.worlds.observe().numpy().copy()
        return seen

    def step_async(self, actions: np.ndarray) -> None:
        """Note actions (W, 3)."""
        self._actions = torch.from_numpy(np.asarray(actions, dtype=np.float32))

    @torch.no_grad()
    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Take a step; what is over begins again at once.

        Time up is an end like any other, since the time that is left is seen.
        """
        done = self.worlds.advance(with_hold(self._actions))
        rewards = (done.rewards - PRESS_PENALTY * pressed(self.worlds)).numpy().astype(np.float32)
        over = done.terminated | done.truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.count)]
        if over.any():
            last = self._seen()
            for slot in np.flatnonzero(over):
                infos[slot]["terminal_observation"] = last[slot]
            self.worlds.reset(self._draw(np.flatnonzero(over)))
        return self._seen(), rewards, over, infos

    def close(self) -> None:
        """Nothing is open."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """None for each lane: they have no attributes of their own."""
        return [None] * self.count

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refused."""
        raise AttributeError(f"lanes have no {attr_name}")

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> Any:
        """Refused."""
        raise AttributeError(f"lanes have no {method_name}")

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """No lane is."""
        return [False] * self.count


class Snapshots(BaseCallback):
    """Keeps what did best on validation goals, and stops when the seconds are used up."""

    def __init__(self, seconds: float, validate: Callable[[], float]) -> None:
        super().__init__()
        self.seconds, self.validate = seconds, validate
        self.spent, self.best, self.due = 0.0, -np.inf, 1
        self.kept: dict[str, Tensor] = {}
        self.since = time.process_time()

    def _on_step(self) -> bool:
        return self.due <= SNAPSHOTS

    def _on_rollout_start(self) -> None:
        """After an update of the weights: count it, and look whether a snapshot is due."""
        self.spent += time.process_time() - self.since
        while self.due <= SNAPSHOTS and self.spent >= self.due * self.seconds / SNAPSHOTS:
            self.due += 1
            score = self.validate()
            if score >= self.best:
                policy = self.model.policy.state_dict()
                self.best, self.kept = score, {k: v.clone() for k, v in policy.items()}
                normal = self.training_env.obs_rms
                self.kept |= {
                    "mean": torch.from_numpy(normal.mean.copy()),
                    "var": torch.from_numpy(normal.var.copy()),
                }
        self.since = time.process_time()


def with_hold(moves: Tensor) -> Tensor:
    """Actions (W, 4) of moves (W, 3)."""
    return torch.cat([moves, torch.ones_like(moves[:, :1])], dim=1)


def new_worlds(task: str) -> TensorControlWorlds:
    """The episodes that all methods play."""
    return TensorControlWorlds(
        task, WORLDS, start="held", horizon=HORIZON.get(task), action_penalty=0.0
    )


def by_ppo(task: str, seconds: float, seed: int, goals: range) -> tuple[PlayedControl, dict]:
    """Train by PPO for so many CPU seconds, and play goals."""
    lanes, judging = Lanes(new_worlds(task), seed=seed), new_worlds(task)
    normal = VecNormalize(lanes, gamma=0.99)
    steps = lanes.worlds.horizon
    model = PPO(
        "MlpPolicy", normal, n_steps=steps, batch_size=WORLDS * steps // 4, seed=seed, device="cpu",
        policy_kwargs={"net_arch": [256, 256], "activation_fn": nn.ELU, "log_std_init": -1.0},
    )  # fmt: skip

    def act(seen: Tensor) -> Tensor:
        moves, _ = model.predict(normal.normalize_obs(seen.numpy()), deterministic=True)
        return with_hold(torch.from_numpy(moves))

    def validate() -> float:
        played = play_control(judging, act, range(50_000, 50_000 + VALIDATE))
        return float(played.scores.mean())

    snapshots = Snapshots(seconds, validate)
    # rewards' running return begins anew with the environment, so one call of `learn`
    model.learn(10**9, callback=snapshots)
    normal.obs_rms.mean, normal.obs_rms.var = (
        snapshots.kept.pop(name).numpy() for name in ("mean", "var")
    )
    model.policy.load_state_dict(snapshots.kept)
    about = {"cpu_s": snapshots.spent, "updates": model.num_timesteps // (WORLDS * steps),
             "validation_score": snapshots.best}  # fmt: skip
    return play_control(judging, act, goals), about


def by_gradients(
    task: str, method: str, seconds: float, seed: int, goals: range, work: Path
) -> tuple[PlayedControl, dict]:
    """Train by `train-control` for so many CPU seconds, and play goals."""
    side = PLANS if method == "plan" else {"worlds": WORLDS, "episodes": EPISODES}
    config = ControlTrainConfig(
        task=task, method=method, minutes=seconds / 60, **side, horizon=HORIZON.get(task),
        snapshots=SNAPSHOTS, validate=VALIDATE, seed=seed,
        out=work / f"{task}-{method}-{seconds:g}-{seed}",
    )  # fmt: skip
    report = train_control(config)
    tested = evaluate_control(config.out, episodes=len(goals))
    left = np.array([np.inf if each is None else each for each in tested["left"]])
    solved = np.zeros(len(left), bool)
    solved[: tested["test"]["n_success"]] = True  # which ones does not matter here
    about = {"cpu_s": report.cpu_seconds, "updates": report.updates,
             "validation_score": report.validation[report.chosen]["mean_score"]}  # fmt: skip
    return PlayedControl(left, np.array(tested["scores"]), solved), about


def told(played: PlayedControl) -> dict[str, Any]:
    """What the ends of episodes amount to; distances count a fired guard as infinite."""
    fine = np.isfinite(played.left)
    low, high = bootstrapped(100 * played.left[fine])
    summary = played.summary()
    return {
        "goals": len(played.left),
        "guards": summary["n_guards"],
        "mean_cm": 100 * summary["mean_left"],
        "mean_cm_low": low,
        "mean_cm_high": high,
        **{f"within_{cm}_cm": int((played.left < cm / 100).sum()) for cm in (10, 5, 2, 1)},
        "solved": summary["n_success"],
        "score": summary["mean_score"],
        "score_low": summary["mean_score_ci95"][0],
        "score_high": summary["mean_score_ci95"][1],
    }


def main() -> None:
    """Train, test, and append rows."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--tasks", nargs="+", default=list(TASKS))
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=METHODS)
    parser.add_argument("--seconds", type=float, default=150.0)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--goals", type=int, default=200)
    parser.add_argument("--work", type=Path, default=Path("build/control_policies"))
    parser.add_argument(
        "--out", type=Path, default=Path("benchmarks/results/control_policies.jsonl")
    )
    options = parser.parse_args()
    torch.set_num_threads(1)
    quiet_warp()
    lines = options.out.read_text().splitlines() if options.out.exists() else []
    known = ("task", "method", "seed", "seconds", "goals")
    there = {tuple(json.loads(line)[name] for name in known) for line in lines}
    goals = range(10_000, 10_000 + options.goals)
    for seed in options.seeds:
        for task in options.tasks:
            for method in options.methods:
                seconds = 0.0 if method == "still" else options.seconds
                cell = (task, method, seed, seconds, options.goals)
                if cell in there or (method == "still" and seed != options.seeds[0]):
                    continue
                if method == "plan" and task in HORIZON:
                    continue
                if method == "still":
                    still = with_hold(torch.zeros(WORLDS, 3))
                    played = play_control(new_worlds(task), lambda _, s=still: s, goals)
                    about: dict[str, Any] = {"cpu_s": 0.0, "updates": 0, "validation_score": None}
                elif method == "ppo":
                    played, about = by_ppo(task, seconds, seed, goals)
                else:
                    played, about = by_gradients(task, method, seconds, seed, goals, options.work)
                row = {**dict(zip(known, cell, strict=True)), **about, **told(played),
                       "load": os.getloadavg()[0]}  # fmt: skip
                print(json.dumps(row), flush=True)
                with options.out.open("a") as file:
                    file.write(json.dumps(row) + "\n")


if __name__ == "__main__":
    main()
