"""What threads bring: the same work in one process on one thread and on several.

    python benchmarks/threads.py [--tasks cable-shape fabric-flat] [--threads 2] [--json]

A step of a vector environment of 16 and of 64 episodes; the choice of an action by `mpc`, in one
episode, of which all 8 candidates fit into one group of lanes, and in four; that of the planner in
one episode; derivatives of 16 worlds. Worlds on one thread and on several take turns at the same
work from the same states, and have to end in the same bits. Printed are the ratios of the shortest
times: wall clock of one thread over that of several, and CPU time of several over that of one.
Other work on the machine spoils the first, so its load is printed too; where it is not idle,
`chrt -f 1 python benchmarks/threads.py` puts this one first.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np

from warp_deform.envs.vector_env import PickPlaceVectorEnv
from warp_deform.planning import Lookahead, SearchConfig, search
from warp_deform.quiet import quiet_warp
from warp_deform.rollout import DifferentiableRollout
from warp_deform.tasks.registry import task as find_task
from warp_deform.worlds import Worlds
from warp_deform.worlds.state import WorldState

CANDIDATES = 8
Job = Callable[[], object]
"""Does the work once, and returns what shows its bits."""


@dataclass(frozen=True)
class Row:
    """Shortest times of one piece of work [ms], and their ratios."""

    task: str
    work: str
    threads: int
    wall_ms: float
    cpu_ms: float
    faster: float
    cpu_ratio: float
    load: float


def on_threads(count: int) -> None:
    """What is made from now on runs on so many threads."""
    os.environ["OMP_NUM_THREADS"] = str(count)


def vector(task: str, count: int) -> Job:
    """A step of `count` environments, by the scripted demonstrator."""
    envs = PickPlaceVectorEnv(task, count, autoreset_mode="Disabled")
    envs.reset(seed=0)
    worlds = envs.worlds
    states = [worlds.state(i) for i in range(count)]
    chosen = envs.demonstrate("scripted")
    actions = np.stack([envs.single_action_space.low if a is None else a for a in chosen])

    def step() -> object:
        for i, state in enumerate(states):
            worlds.restore(i, state)
        envs.ended[:] = False
        envs.step(actions)
        return [worlds.hash(i) for i in range(count)]

    return step


def start(task: str) -> tuple[WorldState, list[np.ndarray]]:
    """An episode's start, and actions to try from there."""
    worlds = Worlds(task)
    worlds.reset({0: 0})
    episode = worlds.episodes[0]
    rng = np.random.default_rng(0)
    proposed = worlds.task.candidates(episode.layout, episode.snapshot, rng, CANDIDATES)
    return worlds.state(0), list(proposed)[:CANDIDATES]


def mpc(task: str, episodes: int) -> Job:
    """What the candidates of so many episodes, here alike, lead to."""
    state, actions = start(task)
    count = CANDIDATES * max(2, episodes)
    ahead = Lookahead(find_task(task), robot="ur5", precision="float32", count=count)
    jobs = [(state, action) for action in actions * episodes]
    return lambda: [o.rank for o in ahead.try_each(jobs)]


def planner(task: str) -> Job:
    """A search for one action."""
    state, _ = start(task)
    found = find_task(task)
    ahead = Lookahead(found, robot="ur5", precision="float32", count=2 * CANDIDATES)

    def act() -> object:
        rng = np.random.default_rng(1)
        return [o.action.tobytes() for o in search(ahead, found, state, rng, SearchConfig())]

    return act


def gradients(task: str) -> Job:
    """Derivatives of where 16 falling worlds are after 0.2 s."""
    worlds = Worlds(task, 16)
    worlds.reset({i: i for i in range(16)})
    states = [worlds.state(i) for i in range(16)]
    run = DifferentiableRollout(worlds.solver, sleep=False)

    def sweep() -> object:
        for i, state in enumerate(states):
            worlds.restore(i, state)
            worlds.solver.data.lane("particles.x", i)[:, 2] += 0.02
        ends = run.forward(range(16), [0.2])
        return ends.tobytes(), run.backward(np.cos(ends)).positions.tobytes()

    return sweep


WORK: dict[str, Callable[[str], Job]] = {
    "vector 16": lambda task: vector(task, 16),
    "vector 64": lambda task: vector(task, 64),
    "mpc": lambda task: mpc(task, 1),
    "mpc 4": lambda task: mpc(task, 4),
    "planner": planner,
    "gradients": gradients,
}


def compare(task: str, work: str, threads: int, repeats: int) -> Row:
    """Both numbers of threads in turns; the first turn of each is a rehearsal."""
    jobs: dict[int, Job] = {}
    for count in (1, threads):
        on_threads(count)
        jobs[count] = WORK[work](task)
    wall, cpu = dict.fromkeys(jobs, np.inf), dict.fromkeys(jobs, np.inf)
    for turn in range(repeats + 1):
        seen = []
        for count, job in jobs.items():
            begin, busy = time.perf_counter(), time.process_time()
            seen.append(job())
            took = time.perf_counter() - begin, time.process_time() - busy
            if turn:
                wall[count], cpu[count] = min(wall[count], took[0]), min(cpu[count], took[1])
        if seen[0] != seen[1]:
            raise AssertionError(f"{task}, {work}: {threads} threads changed the bits")
    return Row(
        task=task,
        work=work,
        threads=threads,
        wall_ms=round(1e3 * wall[threads], 1),
        cpu_ms=round(1e3 * cpu[threads], 1),
        faster=round(wall[1] / wall[threads], 2),
        cpu_ratio=round(cpu[threads] / cpu[1], 2),
        load=round(os.getloadavg()[0], 1),
    )


def main() -> None:
    """Print a row for every task and piece of work."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="*", default=["cable-shape", "fabric-flat"])
    parser.add_argument("--work", nargs="*", choices=WORK, default=list(WORK))
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=8)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    quiet_warp()
    rows = []
    for task in options.tasks:
        for work in options.work:
            row = compare(task, work, options.threads, options.repeats)
            rows.append(row)
            if not options.json:
                print(
                    f"{task:14} {work:10} {row.wall_ms:8.1f} ms, {row.faster:.2f} times as fast, "
                    f"{row.cpu_ratio:.2f} times the CPU time, load {row.load}",
                    flush=True,
                )
    if options.json:
        print(json.dumps({"cores": os.cpu_count(), "rows": [asdict(row) for row in rows]}))


if __name__ == "__main__":
    main()
