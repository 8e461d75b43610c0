"""Draw a crumpled cable straight: the end is gripped, led along a path, and let go.

    python examples/drag_cable.py [--out line.png]

A `GripPath` is a list of waypoints over simulated time; one launch runs all of it.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import newton
import numpy as np

from warp_deform.objects import CableConfig, add_cable
from warp_deform.quiet import quiet_warp
from warp_deform.rendering.drawables import Drawables
from warp_deform.rendering.topdown import TopDown
from warp_deform.rendering.video import write_png
from warp_deform.rollout import GripPath, rollout
from warp_deform.solver import SolverFusedXPBD

LIFT, SPEED = 0.04, 0.15  # [m], [m/s]


def zigzag(cable: CableConfig, x: float) -> np.ndarray:
    """Beads (n, 3) [m] on the table in folds 12 beads long."""
    row, place = np.divmod(np.arange(cable.beads), 12)
    y = cable.spacing * np.where(row % 2, 11 - place, place)
    return np.column_stack([x + 1.2 * cable.spacing * row, y, np.full(cable.beads, cable.radius)])


def main(out: Path | None = None) -> float:
    """Run the drag; returns the largest distance of a bead from the straight line [m]."""
    cable = CableConfig()
    builder = newton.ModelBuilder()
    SolverFusedXPBD.register_custom_attributes(builder)
    handle = add_cable(builder, cable, zigzag(cable, 0.28))
    solver = SolverFusedXPBD(builder.finalize(device="cpu"))
    rollout(solver, [0], min_seconds=0.5, max_seconds=3.0)

    start = solver.particle_q(0)[-1].astype(float)
    goal = np.array([0.72, 0.0, start[2]])
    up = np.array([0.0, 0.0, LIFT])
    # lowered on a slope: straight down, the lifted part of the cable would fold under the tip
    knots = np.array([start, start + up, goal + up - [LIFT, 0.0, 0.0], goal, goal])
    lengths = np.linalg.norm(np.diff(knots[:-1], axis=0), axis=1)
    # a short rest on the table before the release lets the links settle
    times = np.concatenate([[0.0], np.cumsum(lengths / SPEED)])
    path = GripPath(np.append(times, times[-1] + 0.2), knots, particle=cable.beads - 1)
    result = rollout(solver, [0], paths={0: path}, min_seconds=0.3, max_seconds=times[-1] + 5.0)[0]

    beads = solver.particle_q(0)
    assert not result.watch.problems(0, solver.config.limits)
    assert np.linalg.norm(beads[-1] - goal) < 0.005, "the end is not where it was put"
    # straightness: distance from the end to end line, and end distance over length
    along = (beads[-1] - beads[0])[:2]
    span = float(np.hypot(*along))
    normal = np.array([-along[1], along[0]]) / span
    off = float(np.abs((beads[:, :2] - beads[0, :2]) @ normal).max())
    straight = span / ((cable.beads - 1) * cable.spacing)
    assert straight > 0.99 and off < 0.01, (straight, off)
    print(f"end to end {100 * straight:.1f} % of the length, {1e3 * off:.1f} mm off the line")

    if out is not None:
        images = TopDown().render(Drawables.of([handle]), beads, np.zeros((0, 7), np.float32))
        write_png(out, images.color)
        print(f"wrote {out}")
    return off


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, help="picture from above (PNG)")
    quiet_warp()
    main(parser.parse_args().out)
