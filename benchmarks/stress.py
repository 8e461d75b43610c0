"""Random and adversarial actions by the thousand: what becomes of them, and what breaks.

    python benchmarks/stress.py [--actions 10000] [--tasks cable-ring ...] [--seed 0] [--json]

Every task gets an equal share of the actions, in lanes. Kinds of action, in equal shares: anywhere,
corners of the action space, on an object, between two objects, nowhere far (place = pick), tugging
at full lift or none, tiny moves, and picks at the edge of what the arm reaches. An episode goes on
for ten actions, or until a guard fires.

Exit code 1 if anything was broken: a state that is not finite, or a height or score out of range,
while `physics_ok`; an untrusted state without a named problem, or one that counts as a success; an
action that lasts longer than its path and the time it may take to come to rest.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from warp_deform.episodes import MAX_HEIGHT
from warp_deform.quiet import quiet_warp
from warp_deform.robots.primitive import Outcome
from warp_deform.tasks.registry import TASKS
from warp_deform.worlds import Worlds
from warp_deform.worlds.episode import StepReport
from warp_deform.worlds.spaces import action_space, check_action
from warp_deform.worlds.worlds import REST_LIMIT

EPISODE = 10  # [actions]
MOVING = 0.02  # [m/s] faster than this is not at rest
LONGEST_MOTION = 60.0  # [s] of tip motion, above what the longest path over the table takes


@dataclass
class Tally:
    """What became of a task's actions."""

    task: str
    actions: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    problems: Counter[str] = field(default_factory=Counter)
    kinds_of_invalid: Counter[str] = field(default_factory=Counter)
    solved: int = 0
    restless: int = 0
    longest: float = 0.0
    seconds: float = 0.0
    broken: list[str] = field(default_factory=list)


def stress(
    task: str, *, actions: int, seed: int = 0, count: int = 16, started: Worlds | None = None
) -> Tally:
    """Act `actions` times on `count` worlds of a task and look at every state.

    If `started` is given, its first `count` slots are acted on, each at a start already.
    """
    rng = np.random.default_rng([seed, *task.encode()])
    worlds = Worlds(task, count) if started is None else started
    tally = Tally(task)
    fresh = seed
    begin = time.perf_counter()
    slots = list(range(count))
    waiting = slots if started is None else []
    while tally.actions < actions:
        if waiting:
            worlds.reset({slot: fresh + k for k, slot in enumerate(waiting)})
            fresh += len(waiting)
        chosen = slots[: actions - tally.actions]
        drawn = {slot: draw(rng, worlds, slot) for slot in chosen}
        reports = worlds.step({slot: check_action(action) for slot, (_, action) in drawn.items()})
        for slot, report in reports.items():
            examine(tally, worlds, slot, report, *drawn[slot])
        waiting = [
            slot
            for slot in chosen
            if not worlds.episodes[slot].physics_ok or len(worlds.episodes[slot].actions) >= EPISODE
        ]
    tally.seconds = time.perf_counter() - begin
    return tally


def draw(rng: np.random.Generator, worlds: Worlds, slot: int) -> tuple[str, np.ndarray]:
    """Kind of an action, and one of this kind for the state of a slot."""
    space = action_space()
    anywhere = rng.uniform(space.low, space.high)
    corner = np.where(rng.random(7) < 0.5, space.low, space.high)
    pick, other = _on_object(rng, worlds, slot), _on_object(rng, worlds, slot)
    step = anywhere.copy()
    kind = str(rng.choice(KINDS))
    if kind == "corner":
        step = corner
    elif kind == "object":
        step[:2] = pick
    elif kind == "between objects":
        step[:2], step[3:5] = pick, other
    elif kind == "place = pick":
        step[:2] = step[3:5] = pick
    elif kind == "extreme lift":
        step[:2], step[6] = pick, corner[6]
    elif kind == "tiny move":
        step[:2], step[3:5] = pick, pick + rng.normal(0.0, 0.001, 2)
    elif kind == "edge of reach":
        radius = worlds.robot.reach(float(step[6]))[1] + rng.normal(0.0, 0.002)
        angle = rng.uniform(-0.6, 0.6)
        step[:2], step[3:5] = pick, (radius * np.cos(angle), radius * np.sin(angle))
    return kind, np.clip(step, space.low, space.high)


KINDS = (
    "anywhere", "corner", "object", "between objects", "place = pick", "extreme lift",
    "tiny move", "edge of reach",
)  # fmt: skip


def _on_object(rng: np.random.Generator, worlds: Worlds, slot: int) -> np.ndarray:
    """A point (2,) on or near a random particle or body."""
    state = worlds.episodes[slot].snapshot
    points = state.points
    return points[rng.integers(len(points))] + rng.normal(0.0, 0.003, 2)


def examine(
    tally: Tally, worlds: Worlds, slot: int, report: StepReport, kind: str, action: np.ndarray
) -> None:
    """Count an action and note everything that must not be."""
    episode = worlds.episodes[slot]
    state = episode.snapshot
    tally.actions += 1
    tally.outcomes[report.outcome.value] += 1
    tally.problems.update(problem.kind.value for problem in episode.problems)
    if not episode.physics_ok:
        tally.kinds_of_invalid[kind] += 1
    tally.longest = max(tally.longest, report.seconds)
    arrays = (state.particle_q, state.particle_qd, state.body_q, state.body_qd)
    finite = all(np.isfinite(array).all() for array in arrays)
    score, solved = worlds.score(slot), worlds.solved(slot)
    tally.solved += int(solved)
    if finite:
        speeds = [
            *np.linalg.norm(state.particle_qd, axis=1),
            *np.linalg.norm(state.body_qd[:, :3], axis=1),
        ]
        tally.restless += int(max(speeds) > MOVING)
    moving = sum(motion.seconds for motion in report.motions)
    checks = {
        "outcome without a name": isinstance(report.outcome, Outcome),
        "invalid without a problem": (report.outcome is Outcome.INVALID) == bool(episode.problems),
        "not finite, physics_ok": finite or not episode.physics_ok,
        "success on an invalid state": not solved or episode.physics_ok,
        "score out of [0, 1]": 0.0 <= score <= 1.0,
        "lasts too long": report.seconds <= moving + 2 * REST_LIMIT and moving <= LONGEST_MOTION,
    }
    if finite and episode.physics_ok:
        height = state.images.height
        checks["height out of range"] = bool((height >= 0).all() and (height <= MAX_HEIGHT).all())
    for what, good in checks.items():
        if not good:
            numbers = np.array2string(action, precision=17, separator=",", max_line_width=1000)
            before = f"seed {episode.seed}, action number {len(episode.actions)}"
            tally.broken.append(f"{what}: {before}, {kind} {numbers}")


def table(tallies: list[Tally]) -> str:
    """The tallies as a Markdown table, with totals below."""
    names = [outcome.value for outcome in Outcome]
    head = [
        "task",
        "actions",
        *names,
        "solved",
        "still moving",
        "longest [s]",
        "broken",
        "wall [s]",
    ]
    rows = [
        [
            t.task,
            t.actions,
            *(t.outcomes[name] for name in names),
            t.solved,
            t.restless,
            f"{t.longest:.1f}",
            len(t.broken),
            f"{t.seconds:.1f}",
        ]
        for t in tallies
    ]
    lines = ["| " + " | ".join(map(str, row)) + " |" for row in (head, ["---"] * len(head), *rows)]
    for title, name in (("problems", "problems"), ("invalid after", "kinds_of_invalid")):
        total: Counter[str] = sum((getattr(t, name) for t in tallies), Counter())
        said = ", ".join(f"{kind} {number}" for kind, number in total.most_common())
        lines.append(f"\n{title}: {said or 'none'}")
    return "\n".join([*lines, *(f"\n{t.task}: {what}" for t in tallies for what in t.broken)])


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--actions", type=int, default=10_000, help="of all tasks together")
    parser.add_argument("--tasks", nargs="+", choices=list(TASKS), default=list(TASKS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--worlds", type=int, default=16, help="side by side")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of a table")
    options = parser.parse_args()
    if options.actions < 1 or options.worlds < 1 or options.seed < 0:
        parser.error("--actions and --worlds must be positive, --seed not negative")
    quiet_warp()
    share = -(-options.actions // len(options.tasks))
    tallies = [
        stress(task, actions=share, seed=options.seed, count=options.worlds)
        for task in options.tasks
    ]
    report: dict[str, Any] = {
        "actions": sum(t.actions for t in tallies),
        "broken": sum(len(t.broken) for t in tallies),
        "rows": [vars(t) for t in tallies],
    }
    print(json.dumps(report) if options.json else table(tallies))
    return 1 if report["broken"] else 0


if __name__ == "__main__":
    sys.exit(main())
