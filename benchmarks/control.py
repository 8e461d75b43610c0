"""What a control step costs: launches that go on, beside a chain of launches, in the same run.

    python benchmarks/control.py [--scenes cable fabric] [--worlds 1 32] [--mujoco] [--json]

A control step is 50 ms, 60 substeps. In every world the first particle is held, and its tip goes to
a target that was drawn near the last one; after each step all positions are read. `continued` goes
on with one launch (`ControlLoop`), `chain` starts a new one at every step (`rollout`), lets go and
lists contacts anew. `continued-gradient` and `chain-gradient` are whole episodes of 20 steps and
the way back, with `TensorControlLoop` and a chain of `rollout_tensors`; what is held is let go
between two of the latter, too.

Process CPU microseconds per control step and world, float32, one thread, kernels compiled before,
the least over repeats that take turns, and control steps a second and core. `times` is how much
longer the chain takes, and how much longer MuJoCo takes than `continued`. Worlds stand side by side
in 8 lanes; a lone world has a lane of its own.

With `--mujoco` a lone cable and a lone fabric run in MuJoCo, too, with the same targets; what is
held is joined to a tip that it follows by some millimetres. More of its worlds make a core no
faster, so `times_many` is the same beside the most worlds of ours. The cable's settings are the
cheapest of 24 (120 to 960 steps a second, CG and Newton, joints and tendons) after which links were
within 2 % of their length at the end, as `stretch` tells of all; those that suffice for a fall onto
the table stretch them by a fifth. The fabric's are the cheapest of 18 (120 to 480 steps a second, 5
to 20 iterations, constraints of edges and of vertices) after which no edge was longer than 1.05 of
its length; with constraints of vertices it flies apart.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace

import newton
import numpy as np
import torch

from warp_deform.objects import CableConfig, ClothConfig, add_cable, add_cloth, cloth_sheet
from warp_deform.peers.mujoco_peer import MujocoSettings, MujocoWorld
from warp_deform.peers.mujoco_soft import MujocoSoftSettings, MujocoSoftWorld
from warp_deform.peers.scene import peer_scene
from warp_deform.peers.soft_scene import soft_scene
from warp_deform.peers.timing import FRAME_RATE
from warp_deform.quiet import quiet_warp
from warp_deform.rollout import (
    ControlLoop,
    GripPath,
    TensorControlLoop,
    rollout,
    rollout_tensors,
)
from warp_deform.solver import GuardLimits, SolverConfig, SolverFusedXPBD
from warp_deform.tasks.cloth_physics import FABRIC_SOLVER

LANES, SECONDS, STEPS, REPEATS = 8, 0.05, 20, 5
CABLE, CLOTH = CableConfig(), ClothConfig(edge_contact=0.2)
LIMITS = GuardLimits(stretch=1e9, depth=1e9, clamped_steps=10**9)
SOLVERS = {
    "cable": SolverConfig(damping=1.0, limits=LIMITS),
    "fabric": FABRIC_SOLVER,
}
MUJOCO = MujocoSettings(hz=240, solver="CG", iterations=20, tolerance=1e-4, links="connect")
MUJOCO_SOFT = MujocoSoftSettings(hz=120, iterations=10)
Episode = Callable[[], np.ndarray]
"""Plays 20 control steps from the start; returns the last positions."""


@dataclass(frozen=True)
class Row:
    """One way to take control steps, beside the chain of launches that does the same."""

    scene: str
    worlds: int
    how: str
    us: float
    steps_per_second: float
    times: float | None
    stretch: float
    times_many: float | None = None


class Scene:
    """Worlds of one scene, their starts and the targets of their tips."""

    def __init__(self, name: str, worlds: int) -> None:
        self.name, self.worlds = name, list(range(worlds))
        one, builder = newton.ModelBuilder(), newton.ModelBuilder()
        for each in (one, builder):
            SolverFusedXPBD.register_custom_attributes(each)
        if name == "cable":
            add_cable(one, CABLE, peer_scene("cable").beads)
        else:
            add_cloth(one, CLOTH, cloth_sheet(CLOTH, (0.5, 0.0), height=0.02))
        builder.replicate(one, worlds)
        self.solver = SolverFusedXPBD(
            builder.finalize(device="cpu"),
            SOLVERS[name],
            lanes=LANES if worlds > 1 else 1,
            threads=1,
        )
        first = self.solver.particle_q(0)
        starts = [first if name == "fabric" else peer_scene("cable", seed=w).beads
                  for w in self.worlds]  # fmt: skip
        self.starts = np.array(starts, dtype=np.float32)
        rng = np.random.default_rng(0)
        moves = rng.uniform((-0.02, -0.02, -0.005), (0.02, 0.02, 0.01), (STEPS, worlds, 3))
        self.targets = (self.starts[:, 0] + np.cumsum(moves, axis=0)).astype(np.float32)
        np.clip(self.targets[..., 2], 0.005, None, out=self.targets[..., 2])

    def reset(self) -> None:
        """Put all worlds to their starts."""
        for w in self.worlds:
            self.solver.data.lane("particles.x", w)[:] = self.starts[w]
            self.solver.data.lane("particles.v", w)[:] = 0.0
            self.solver.data.wake(w)

    def path(self, w: int, start: np.ndarray, target: np.ndarray) -> GripPath:
        return GripPath(np.array([0.0, SECONDS]), np.stack([start, target]), particle=0)

    def stretch(self, positions: np.ndarray) -> float:
        """Longest link over its rest length."""
        springs = self.solver.data.topologies[0]
        watched = np.asarray(springs.spring_watched) > 0
        i, j = np.asarray(springs.spring_ij)[watched].T
        lengths = np.linalg.norm(positions[:, i] - positions[:, j], axis=-1)
        return float((lengths / np.asarray(springs.spring_length)[watched]).max())

    def ways(self) -> dict[str, Episode]:
        """The ways to take control steps, by name; each begins with new worlds."""
        loop = ControlLoop(self.solver)
        tensors = TensorControlLoop(self.solver)

        def continued() -> np.ndarray:
            loop.begin(self.worlds)
            for w in self.worlds:
                loop.hold(w, particle=0)
            for target in self.targets:
                loop.advance(target)
                positions = loop.particle_q()
            loop.end()
            return positions

        def chain() -> np.ndarray:
            at = self.starts[:, 0]
            for target in self.targets:
                paths = {w: self.path(w, at[w], target[w]) for w in self.worlds}
                rollout(self.solver, self.worlds, paths=paths, min_seconds=1.0, max_seconds=SECONDS)
                positions = np.stack([self.solver.particle_q(w) for w in self.worlds])
                at = target
            return positions

        def with_gradient() -> np.ndarray:
            targets = torch.tensor(self.targets, requires_grad=True)
            state = tensors.begin(self.worlds)
            for w in self.worlds:
                tensors.hold(w, particle=0)
            for target in targets:
                state = tensors.advance(target)
            tensors.end()
            (state.positions**2).sum().backward()
            assert targets.grad is not None
            assert targets.grad[0].any()
            return state.positions.detach().numpy()

        def chain_with_gradient() -> np.ndarray:
            targets = torch.tensor(self.targets, requires_grad=True)
            state = {"positions": torch.tensor(self.starts), "velocities": torch.zeros(1)}
            state["velocities"] = torch.zeros_like(state["positions"])
            at = torch.tensor(self.starts[:, 0])
            for target in targets:
                knots = torch.stack([at, target], dim=1)
                paths = {w: self.path(w, *knots[w].detach().double().numpy()) for w in self.worlds}
                points = {w: knots[w] for w in self.worlds}
                out = rollout_tensors(
                    self.solver, self.worlds, [SECONDS], paths=paths, waypoints=points, **state
                )
                state = {n: out.end[n] for n in ("positions", "velocities")}
                at = target
            (state["positions"] ** 2).sum().backward()
            assert targets.grad is not None
            assert targets.grad[0].any()
            return state["positions"].detach().numpy()

        return {
            "continued": continued,
            "chain": chain,
            "continued-gradient": with_gradient,
            "chain-gradient": chain_with_gradient,
        }


class MujocoCable:
    """The lone cable in MuJoCo."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene

    def reset(self) -> None:
        """Begin anew."""
        self.world = MujocoWorld(peer_scene("cable"), MUJOCO, held=0)

    def play(self) -> np.ndarray:
        for target in self.scene.targets[:, 0]:
            self.world.lead(target, SECONDS)
            positions = self.world.beads()
        return positions[None, : CABLE.beads]


class MujocoFabric:
    """The lone fabric in MuJoCo: a flex with self-contact, held by its first vertex."""

    def __init__(self, scene: Scene, settings: MujocoSoftSettings = MUJOCO_SOFT) -> None:
        self.scene, self.settings = scene, settings

    def reset(self) -> None:
        """Begin anew."""
        start = replace(soft_scene("fold10"), vertices=self.scene.starts[0].astype(float))
        self.world = MujocoSoftWorld(start, self.settings)
        self.world.hold()

    def play(self) -> np.ndarray:
        at, frames = self.scene.starts[0, 0].astype(float), round(SECONDS * FRAME_RATE)
        for target in self.scene.targets[:, 0]:
            for k in range(frames):
                self.world.frame(at + (k + 1) / frames * (target - at))
            at, positions = target, self.world.vertices()
        return positions[None]


def measure(name: str, worlds: int, *, mujoco: bool) -> list[Row]:
    """All ways of one scene, taking turns."""
    scene = Scene(name, worlds)
    ways = {how: (scene.reset, play) for how, play in scene.ways().items()}
    if mujoco and worlds == 1:
        peer = MujocoCable(scene) if name == "cable" else MujocoFabric(scene)
        ways["mujoco"] = peer.reset, peer.play
    best, stretch = dict.fromkeys(ways, np.inf), {}
    for turn in range(REPEATS + 1):
        for how, (reset, play) in ways.items():
            reset()
            begun = time.process_time()
            positions = play()
            spent = time.process_time() - begun
            if not np.isfinite(positions).all():
                raise SystemExit(f"{name}, {how}: the positions are not finite")
            stretch[how] = scene.stretch(positions)
            if turn:  # the first one loads kernels
                best[how] = min(best[how], spent)
    each = {how: spent / (STEPS * worlds) for how, spent in best.items()}
    beside = {"continued": "chain", "continued-gradient": "chain-gradient"}
    times = {how: each[other] / each[how] for how, other in beside.items()}
    if "mujoco" in each:
        times["mujoco"] = each["mujoco"] / each["continued"]
    return [
        Row(
            scene=name,
            worlds=worlds,
            how=how,
            us=1e6 * each[how],
            steps_per_second=1 / each[how],
            times=times.get(how),
            stretch=stretch[how],
        )
        for how in ways
    ]


def main() -> None:
    """Measure, and print rows."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", nargs="+", choices=sorted(SOLVERS), default=sorted(SOLVERS))
    parser.add_argument("--worlds", nargs="+", type=int, default=[1, 32])
    parser.add_argument("--mujoco", action="store_true")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    quiet_warp()
    torch.set_num_threads(1)
    rows: list[Row] = []
    for name in options.scenes:
        for worlds in options.worlds:
            rows += measure(name, worlds, mujoco=options.mujoco)
    ours = {row.scene: row.us for row in rows if row.how == "continued"}  # the most worlds' stay
    rows = [
        replace(row, times_many=row.us / ours[row.scene]) if row.how == "mujoco" else row
        for row in rows
    ]
    if options.json:
        print(json.dumps({"load": os.getloadavg()[0], "rows": [asdict(row) for row in rows]}))
        return
    for row in rows:
        times = "" if row.times is None else f"{row.times:6.1f} times"
        print(
            f"{row.scene:7} {row.worlds:3} {row.how:19} {row.us:9.1f} us "
            f"{row.steps_per_second:9.0f}/s {times:13} stretch {row.stretch:.3f}"
        )


if __name__ == "__main__":
    main()
