"""Inverse kinematics: time per pose and success rate, beside pytorch-kinematics' own solver.

Both solve the same 80 tip-down poses in the same run, one by one and as one batch, from a cold
posture (no seed from a neighbour), on one thread. A pose counts as met within 1 mm and 0.01 rad, by
forward kinematics and within the joint limits.

    python benchmarks/kinematics.py [--robot ur5|panda] [--json] [--reach-table]

`--reach-table` prints instead the rows that `warp_deform/robots/ur5.py` and `panda.py` hold.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import tyro

from warp_deform.robots import ROBOTS, Robot, RobotName, robot

BATCH = 80
SINGLES = 20
REPEATS = 5
POSITION_TOLERANCE = 1e-3  # [m]
ROTATION_TOLERANCE = 1e-2  # [rad]
# The tool closer to the base than this would graze the arm's own shoulder.
SMALLEST_RADIUS = 0.20  # [m]
MARGIN = 0.002  # [m]


@dataclass(frozen=True)
class Options:
    """What to measure."""

    robot: RobotName | None = None  # all when left out
    json: bool = False  # one JSON object on stdout
    reach_table: bool = False  # print the reach tables instead


def main(options: Options) -> None:
    """Measure and print."""
    import torch

    torch.set_num_threads(1)
    names = ROBOTS if options.robot is None else (options.robot,)
    if options.reach_table:
        for name in names:
            print(name)
            for row in reach_table(robot(name)):
                print("    ({:.2f}, {:.3f}, {:.3f}),".format(*row))
        return
    rows = {name: measure(robot(name)) for name in names}
    if options.json:
        print(json.dumps({"poses": BATCH, "robots": rows}))
        return
    print(f"{'':7}{'':8}{'ours':>10}{'peer':>10}{'ratio':>8}{'ours':>9}{'peer':>9}")
    print(f"{'robot':7}{'batch':8}{'ms/pose':>10}{'ms/pose':>10}{'':>8}{'met':>9}{'met':>9}")
    for name, row in rows.items():
        for size in ("single", "batch"):
            cell = row[size]
            print(
                f"{name:7}{size:8}{cell['ms_per_pose']:10.3f}{cell['peer_ms_per_pose']:10.3f}"
                f"{cell['ratio']:8.1f}{cell['success']:9.1%}{cell['peer_success']:9.1%}"
            )
        shares = ", ".join(f"{share:.1%} at {z} m" for z, share in row["table_share"].items())
        print(
            f"{name:7}trajectories {row['trajectory_ms_per_pose']:.3f} ms/pose; "
            f"table in reach: {shares}"
        )


def measure(arm: Robot) -> dict:
    """Return the figures of one robot."""
    poses = random_poses(arm, BATCH)
    peer, peer_success = _peer(arm, poses)
    result: dict = {}
    for size, count, repeats in (("single", SINGLES, 1), ("batch", BATCH, REPEATS)):
        step = 1 if size == "single" else BATCH

        def ours(step: int = step, count: int = count) -> list:
            return [arm.solve_top_down(poses[i : i + step]) for i in range(0, count, step)]

        def theirs(step: int = step, count: int = count) -> list:
            return [peer(slice(i, i + step)) for i in range(0, count, step)]

        mine, other = _milliseconds(ours, repeats) / count, _milliseconds(theirs, repeats) / count
        answers = ours()
        met = [_met(a.position_error, a.rotation_error) for a in answers]
        peer_met = [
            peer_success(slice(i * step, (i + 1) * step), q) for i, q in enumerate(theirs())
        ]
        result[size] = {
            "ms_per_pose": mine,
            "peer_ms_per_pose": other,
            "ratio": other / mine,
            "success": float(np.concatenate(met).mean()),
            "peer_success": float(np.concatenate(peer_met).mean()),
        }
    paths = poses[np.lexsort((poses[:, 1], poses[:, 0]))]
    path = _milliseconds(lambda: arm.trajectory(paths, lengths=[10] * (BATCH // 10)), REPEATS)
    result["trajectory_ms_per_pose"] = path / BATCH
    result["table_share"] = {f"{z:.2f}": table_share(arm, z) for z in (0.01, 0.30, 0.40)}
    return result


def random_poses(arm: Robot, count: int, *, seed: int = 0) -> np.ndarray:
    """Return tip-down poses x, y, z, yaw (count, 4) within reach: z 0.01-0.35 m, yaw +-pi/2."""
    rng = np.random.default_rng(seed)
    poses = np.empty((count, 4))
    for row in poses:
        z = rng.uniform(0.01, 0.35)
        radius, turn = rng.uniform(*arm.reach(z)), rng.uniform(-1.1, 1.1)
        yaw = rng.uniform(-0.5, 0.5) * np.pi
        row[:] = radius * np.cos(turn), radius * np.sin(turn), z, yaw
    return poses


def table_share(arm: Robot, z: float) -> float:
    """Return the share of the 0.5 m x 1.0 m table over which the tip-down tip reaches height z."""
    x, y = np.meshgrid(np.linspace(0.25, 0.75, 101), np.linspace(-0.5, 0.5, 201))
    smallest, largest = arm.reach(z)
    radius = np.hypot(x, y)
    return round(float(((smallest <= radius) & (radius <= largest)).mean()), 3)


def reach_table(arm: Robot) -> list[tuple[float, float, float]]:
    """Return rows of height, smallest and largest radius [m] at which every yaw is reached."""
    yaws = np.radians(np.arange(0.0, 360.0, 5.0))
    radii = np.arange(SMALLEST_RADIUS, 1.0, MARGIN)
    rows = []
    for z in np.arange(0.0, 0.701, 0.05):
        grid = np.array([(radius, 0.0, z, yaw) for radius in radii for yaw in yaws])
        every = arm.solve_top_down(grid).reached.reshape(len(radii), -1).all(axis=1)
        # The longest run of radii without a gap.
        edges = np.flatnonzero(np.diff(np.concatenate(([False], every, [False]))))
        first, after = max(
            zip(edges[::2], edges[1::2], strict=True), key=lambda run: run[1] - run[0]
        )
        # Twice: between heights the inner edge bulges outwards.
        smallest = radii[first] + (2.0 * MARGIN if first else 0.0)
        rows.append((round(z, 2), round(smallest, 3), round(radii[after - 1] - MARGIN, 3)))
    return rows


def _peer(arm: Robot, poses: np.ndarray) -> tuple[Callable, Callable]:
    """Return pytorch-kinematics' PseudoInverseIK on these poses, and what checks its answers."""
    import pytorch_kinematics as pk
    import torch

    chain = pk.build_serial_chain_from_urdf(arm.urdf, arm.flange)
    limits = torch.tensor(np.array([arm.q_min, arm.q_max]), dtype=torch.float32)
    # Its targets are flange poses in its own root frame: those of our answers.
    q = torch.from_numpy(arm.solve_top_down(poses).q).to(torch.float32)
    targets = chain.forward_kinematics(q).get_matrix()
    home = torch.tensor(arm.home_q[None], dtype=torch.float32)
    solver = pk.PseudoInverseIK(
        chain,
        pos_tolerance=POSITION_TOLERANCE,
        rot_tolerance=ROTATION_TOLERANCE,
        retry_configs=home,
        max_iterations=100,
        joint_limits=limits.T,
        early_stopping_any_converged=True,
        early_stopping_no_improvement="all",
        lr=0.5,
    )

    def solve(rows: slice) -> np.ndarray:
        return solver.solve(pk.Transform3d(matrix=targets[rows])).solutions[:, 0].detach()

    def success(rows: slice, q: torch.Tensor) -> np.ndarray:
        pose, target = chain.forward_kinematics(q).get_matrix().double(), targets[rows].double()
        position = (pose[:, :3, 3] - target[:, :3, 3]).norm(dim=1)
        turn = pose[:, :3, :3] @ target[:, :3, :3].transpose(1, 2)
        cosine = 0.5 * (turn.diagonal(dim1=1, dim2=2).sum(1) - 1.0)
        inside = ((q >= limits[0] - 1e-3) & (q <= limits[1] + 1e-3)).all(1).numpy()
        return _met(position.numpy(), cosine.clamp(-1.0, 1.0).arccos().numpy()) & inside

    return solve, success


def _met(position_error: np.ndarray, rotation_error: np.ndarray) -> np.ndarray:
    """Return which answers are good to 1 mm and 0.01 rad."""
    return (position_error <= POSITION_TOLERANCE) & (rotation_error <= ROTATION_TOLERANCE)


def _milliseconds(work: Callable[[], object], repeats: int) -> float:
    """Return the median CPU time of a call [ms], after one to warm up."""
    work()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        times.append(1e3 * (time.process_time() - start))
    return float(np.median(times))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
