"""How well a traced policy foresees where the cable will lie, and what that costs.

    python benchmarks/foresight.py RUN [--beside POLICY] [--episodes N] [--plot PNG] [--out FILE]

The snapshot of RUN plays N test episodes of cable-mask-goal. What it foresaw of each of its actions
is compared with the trace of the next mask, point by point, and so is what would be if nothing had
moved. POLICY, a Goal-Split, looks at the same masks in the same process: how much longer does the
one think than the other? The picture shows eight moves drawn by a generator: grey the cable before,
green the goal, black what came of it and red what was foreseen. FILE gets a line.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from learning.evaluation.play import acting
from learning.evaluation.protocol import Protocol
from learning.models.cable_model import after_moves, same_way
from learning.models.traced import LEVEL, Traced, matched_traces
from learning.policy.policy import ImagePolicy, load_policy
from warp_deform.collecting.workers import single_threaded
from warp_deform.quiet import quiet_warp
from warp_deform.support.revision import running_revision
from warp_deform.tasks.cable_mask_goal import CableMaskGoal
from warp_deform.tasks.strand_trace import trace_strand
from warp_deform.worlds.loop import SLOTS, play
from warp_deform.worlds.worlds import Worlds

_SHOWN, _ZOOM = 8, 2
BESIDE = Path(__file__).parent / "results/learning/policies/cable-mask-goal-goal-split-500"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--beside", type=Path, default=BESIDE, help="policy to be timed beside it")
    parser.add_argument("--episodes", type=int, default=40)
    parser.add_argument("--plot", type=Path, help="PNG of eight moves")
    parser.add_argument("--out", type=Path, help="file of JSON lines that gets one")
    options = parser.parse_args()
    quiet_warp()
    policy, other = load_policy(options.run), load_policy(options.beside)
    if not (isinstance(policy, ImagePolicy) and isinstance(policy.agent, Traced)):
        raise SystemExit(f"{options.run} is no traced policy")
    if not isinstance(other, ImagePolicy):
        raise SystemExit(f"{options.beside} sees no masks")
    with single_threaded():
        watched, moves = _played(policy, options.episodes)
        shown = watched[:: max(1, len(watched) // 40)]
        beside, spent = (_seconds(who, shown) for who in (other, policy))
    if not moves:
        raise SystemExit("there was no move whose masks could be traced")
    pixel = 1000 * CableMaskGoal.grid.pixel_size
    wrong = [pixel * np.linalg.norm(m["foreseen"] - m["after"], axis=1).mean() for m in moves]
    still = [pixel * np.linalg.norm(m["now"] - m["after"], axis=1).mean() for m in moves]
    row = {
        "policy": options.run.name,
        "moves": len(moves),
        "error_mm": round(float(np.median(wrong)), 2),
        "error_p90_mm": round(float(np.percentile(wrong, 90)), 2),
        "unmoved_mm": round(float(np.median(still)), 2),
        "unmoved_p90_mm": round(float(np.percentile(still, 90)), 2),
        "act_ms": round(1000 * spent, 1),
        "act_ratio": round(spent / beside, 2),
        "trace_ms": round(1000 * _trace_seconds(shown), 2),
        "commit": running_revision().commit,
    }
    print(json.dumps(row))
    if options.out:
        with options.out.open("a") as file:
            file.write(json.dumps(row) + "\n")
    if options.plot:
        cv2.imwrite(str(options.plot), _drawn(moves))


def _played(
    policy: ImagePolicy, episodes: int
) -> tuple[list[Mapping[str, np.ndarray]], list[dict[str, np.ndarray]]]:
    """What the policy saw, and of each move the lines before, foreseen, after, and of the goal."""
    agent, grid = policy.agent, CableMaskGoal.grid
    assert isinstance(agent, Traced)
    points, seen, protocol = agent.config.points, [], Protocol(split="test", episodes=episodes)
    act = acting(policy, protocol, watch=lambda _slot, what, _action: seen.append(what))
    runs = play(
        Worlds(CableMaskGoal(), SLOTS, lanes=SLOTS), list(protocol.seeds), act=act, look=_masks
    )
    moves = []
    for _slot, run in runs:
        for (mask, goal), (later, _), action in zip(
            run.rows, run.rows[1:], run.actions, strict=False
        ):
            traces, after = matched_traces(mask, goal, points), trace_strand(later, points)
            if traces is None or after is None:
                continue
            pick, place = grid.fractional(action[:2]), grid.fractional(action[3:5])
            (foreseen,) = after_moves(agent.members, traces[0][None], pick[None], place[None])
            lines = {"now": traces[0], "goal": traces[1], "foreseen": foreseen}
            moves.append({**lines, "after": same_way(traces[0], after, pick, place)})
    return seen, moves


def _masks(worlds: Worlds, slot: int) -> tuple[np.ndarray, np.ndarray]:
    """The masks of a cable and of its goal."""
    episode = worlds.episodes[slot]
    assert episode.goal is not None
    pictures = episode.snapshot.images.color, episode.goal.color
    now, goal = (each[..., 0] > LEVEL for each in pictures)
    return now, goal


def _seconds(policy: ImagePolicy, seen: list[Mapping[str, np.ndarray]]) -> float:
    """CPU time of a decision [s], the median."""
    policy.act(seen[0])  # what is done once is not counted
    took = []
    for what in seen:
        began = time.process_time()
        policy.act(what)
        took.append(time.process_time() - began)
    return float(np.median(took))


def _trace_seconds(seen: list[Mapping[str, np.ndarray]]) -> float:
    """CPU time of tracing one mask [s]."""
    began = time.process_time()
    for what in seen:
        trace_strand(what["color"][..., 0] > LEVEL, 45)
    return (time.process_time() - began) / len(seen)


def _drawn(moves: list[dict[str, np.ndarray]]) -> np.ndarray:
    """Eight moves beside each other."""
    chosen = np.random.default_rng(0).choice(len(moves), min(_SHOWN, len(moves)), replace=False)
    looks: dict[str, tuple[Any, int]] = {
        "goal": ((190, 230, 190), 7),
        "now": ((190, 190, 190), 4),
        "after": ((0, 0, 0), 4),
        "foreseen": ((40, 40, 230), 2),
    }
    tiles = []
    for move in (moves[int(k)] for k in chosen):
        tile = np.full((320 * _ZOOM, 160 * _ZOOM, 3), 255, np.uint8)
        for name, (color, width) in looks.items():
            line = np.rint(_ZOOM * move[name][:, ::-1]).astype(np.int32)
            cv2.polylines(tile, [line], False, color, _ZOOM * width // 2, cv2.LINE_AA)
        tile[:, -2:] = 220
        tiles.append(tile)
    return np.hstack(tiles)


if __name__ == "__main__":
    main()
