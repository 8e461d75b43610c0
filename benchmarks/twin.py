"""The paper's physical experiment on the twin: who brings the chain to the goal, how soon.

    python benchmarks/twin.py [--agents planner scripted random] [--out rows.jsonl] [--plot iou.png]
    python benchmarks/twin.py --agents policy --policy runs/mask

Ten goals, and ten tosses for each (the paper: ten goals, an episode each); at most 10 actions, done
above an overlap (intersection over union of the masks) of 0.25. Robot, safety layer, camera,
segmentation and recording are those of `warp-deform franka run --robot sim`; tosses and goals are
of seeds that no demonstration has. Episodes whose physics cannot be trusted, the toss included, or
that end in another error count as failed, after 10 actions. Mean actions are given over all
episodes and over the solved ones, as the paper's. With --out, episodes already in that file are not
played again. Intervals are 95 % and know that tosses at one goal are alike, see
`learning.evaluation.clustered`.
Goals are drawn by their number and nobody chose them; `--first-goal 10 --goals 20` plays others.
The paper's protocol is `--tosses 1` with a policy of 24 demonstrations and 6 held out.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from hardware.choosers.make import make_chooser
from hardware.episodes.episode import EpisodeResult, run_episode
from hardware.episodes.goals import sampled_goal
from hardware.recordings.recorder import EpisodeRecorder, RecorderConfig
from hardware.recordings.scoring import MAX_ACTIONS
from hardware.rig.config import RigConfig
from hardware.rig.rig import open_rig
from learning.evaluation.clustered import clustered_mean, clustered_rate
from warp_deform.collecting.workers import single_threaded
from warp_deform.quiet import quiet_warp
from warp_deform.xpbd.guards import PhysicsError

GOAL_SEED, TOSS_SEED = 700_000, 800_000
PAPER = "7 of 10, mean 7 actions of the solved"


@dataclass(frozen=True)
class Played:
    """One episode: overlaps (1 + actions,) before the first and after every action.

    The overlap is 0 where there was not one picture.
    """

    agent: str
    goal: int
    toss: int
    success: bool
    actions: int
    outcomes: tuple[str, ...]
    overlaps: tuple[float, ...]
    cpu_s: float


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument(
        "--agents",
        nargs="+",
        default=["planner", "scripted", "random"],
        choices=["planner", "scripted", "random", "policy"],
    )
    parser.add_argument("--policy", type=Path, help="training run of cable-mask-goal")
    parser.add_argument("--budget", type=int, help="of the planner")
    parser.add_argument("--goals", type=int, default=10)
    parser.add_argument("--first-goal", type=int, default=0, help="number of the first of them")
    parser.add_argument("--tosses", type=int, default=10, help="for each goal")
    parser.add_argument("--out", type=Path, help="file of JSON lines to which episodes are added")
    parser.add_argument("--plot", type=Path, help="PNG of the overlaps")
    options = parser.parse_args()
    quiet_warp()
    rows = _read(options.out)
    with single_threaded():
        for agent in options.agents:
            goals = range(options.first_goal, options.first_goal + options.goals)
            for goal, toss in itertools.product(goals, range(options.tosses)):
                if any((r.agent, r.goal, r.toss) == (agent, goal, toss) for r in rows):
                    continue
                rows.append(play(agent, goal, toss, policy=options.policy, budget=options.budget))
                if options.out:
                    with options.out.open("a") as file:
                        file.write(json.dumps(asdict(rows[-1])) + "\n")
                print(f"\r{agent} goal {goal} toss {toss}  ", end="", file=sys.stderr)
    print(file=sys.stderr)
    print(
        "| agent | successes / episodes | 95 % | mean actions | of the solved "
        "| last overlap, median | CPU s an action |\n|---|---|---|---|---|---|---|"
    )
    for agent in dict.fromkeys(r.agent for r in rows):
        print(_line(agent, [r for r in rows if r.agent == agent]))
    print(f"\nThe paper's Goal-Split policy on a Franka: {PAPER}.")
    if options.plot:
        _plot(rows, options.plot)


def play(
    agent: str, goal: int, toss: int, *, policy: Path | None = None, budget: int | None = None
) -> Played:
    """One episode on the twin."""
    began = time.process_time()
    try:
        result = _result(agent, goal, toss, policy=policy, budget=budget)
    except PhysicsError:  # of the toss; in an episode it is the result's error
        result = None
    failed = result is None or result.error is not None
    score = None if result is None else result.score
    outcomes = () if result is None else result.outcomes
    return Played(
        agent=agent,
        goal=goal,
        toss=toss,
        success=score is not None and score.success,
        actions=MAX_ACTIONS if failed else len(outcomes),
        outcomes=tuple(outcome.value for outcome in outcomes),
        overlaps=(0.0,) if score is None else score.iou,
        cpu_s=time.process_time() - began,
    )


def _result(
    agent: str, goal: int, toss: int, *, policy: Path | None, budget: int | None
) -> EpisodeResult:
    """Play it.

    Raises:
        PhysicsError: the tossed chain cannot be trusted
    """
    seed = TOSS_SEED + 100 * goal + toss
    with (
        tempfile.TemporaryDirectory() as folder,
        open_rig(RigConfig(robot="sim", camera="sim", seed=seed)) as rig,
    ):
        seen = sampled_goal(GOAL_SEED + goal)
        chooser = make_chooser(
            agent, rig, seen, seed=seed, policy=policy if agent == "policy" else None, budget=budget
        )
        config = RecorderConfig(
            robot_id="sim",
            camera_id="sim",
            actor=chooser.name,
            calibration=rig.calibration.digest(),
        )
        with EpisodeRecorder(Path(folder, "episode"), config, goal_mask=seen.mask) as recorder:
            return run_episode(
                rig.robot,
                rig.camera,
                rig.calibration,
                chooser,
                recorder=recorder,
                goal=seen.mask,
                toss=rig.toss,
            )


def _read(path: Path | None) -> list[Played]:
    if path is None or not path.exists():
        return []
    return [Played(**json.loads(line)) for line in path.read_text().splitlines()]


def _line(agent: str, rows: Sequence[Played]) -> str:
    n, solved = len(rows), sum(r.success for r in rows)
    goals, interval = [r.goal for r in rows], "-"
    if len(set(goals)) > 1:
        low, high = clustered_rate([r.success for r in rows], goals)
        interval = f"{low:.1f} to {high:.1f}"
    last = np.median([r.overlaps[-1] for r in rows])
    cpu = sum(r.cpu_s for r in rows) / max(1, sum(r.actions for r in rows))
    return (
        f"| {agent} | {solved} / {n} | {interval} "
        f"| {_mean(rows)} | {_mean([r for r in rows if r.success])} | {last:.2f} "
        f"| {cpu:.1f} |"
    )


def _mean(rows: Sequence[Played]) -> str:
    """Mean actions and their interval; no interval of a single goal, nothing of nothing."""
    if not rows:
        return "-"
    if len({r.goal for r in rows}) < 2:
        return f"{np.mean([r.actions for r in rows]):.2f}"
    mean, half = clustered_mean([r.actions for r in rows], [r.goal for r in rows])
    return f"{mean:.2f} ± {half:.2f}"


def _plot(rows: Sequence[Played], path: Path) -> None:
    """Overlap after so many actions: every episode thin, the median thick; ended ones stay."""
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    agents = list(dict.fromkeys(r.agent for r in rows))
    figure, all_axes = plt.subplots(
        1, len(agents), figsize=(3.2 * len(agents), 3), sharey=True, squeeze=False
    )
    for axes, agent in zip(all_axes[0], agents, strict=True):
        runs = [
            np.pad(r.overlaps, (0, 11 - len(r.overlaps)), "edge") for r in rows if r.agent == agent
        ]
        axes.plot(np.transpose(runs), color="tab:blue", alpha=0.15, linewidth=1)
        axes.plot(np.median(runs, axis=0), color="black", linewidth=2)
        axes.axhline(0.25, color="tab:green", linestyle="--", linewidth=1)
        axes.set_title(agent)
        axes.set_xlabel("actions")
    all_axes[0][0].set_ylabel("overlap with the goal")
    figure.tight_layout()
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
