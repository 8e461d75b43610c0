"""A scene of your own: a cable falls across a box, and hangs over both sides.

    python examples/own_scene.py [--out drape.png]

Objects go into a Newton builder, the solver takes the finished model, `rollout` runs it to rest.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import newton
import numpy as np

from warp_deform.objects import BoxConfig, BoxPart, CableConfig, add_box, add_cable, cable_line
from warp_deform.quiet import quiet_warp
from warp_deform.rendering.camera import look_at
from warp_deform.rendering.drawables import Drawables
from warp_deform.rendering.scene_view import SceneView
from warp_deform.rendering.video import write_png
from warp_deform.rollout import rollout
from warp_deform.solver import SolverFusedXPBD


def main(out: Path | None = None) -> np.ndarray:
    """Run the scene; returns the beads at rest (24, 3) [m]."""
    block = BoxConfig(parts=(BoxPart((0.08, 0.08, 0.06)),), mass=0.5)
    cable = CableConfig(mass=0.01)
    above = np.add(cable_line(cable, (0.34, 0.0), (0.68, 0.0)), (0.0, 0.0, 0.065))

    builder = newton.ModelBuilder()
    SolverFusedXPBD.register_custom_attributes(builder)
    objects = [add_box(builder, block, (0.5, 0.0, 0.03)), add_cable(builder, cable, above)]
    solver = SolverFusedXPBD(builder.finalize(device="cpu"))
    result = rollout(solver, [0], min_seconds=1.0, max_seconds=5.0)[0]

    beads, box = solver.particle_q(0), solver.body_q(0)
    assert not result.watch.problems(0, solver.config.limits)
    assert result.seconds < 5.0, "the cable did not come to rest"
    # the box carries the middle, both ends reach the table, and the box has not moved
    top = np.abs(beads[:, 0] - 0.5) < 0.03
    np.testing.assert_allclose(beads[top, 2], 0.06 + cable.radius, atol=1e-3)
    assert max(beads[0, 2], beads[-1, 2]) < 0.02
    np.testing.assert_allclose(box[0, :3], [0.5, 0.0, 0.03], atol=1e-3)
    print(f"at rest after {result.seconds:.2f} s; {top.sum()} beads lie on the box")

    if out is not None:
        camera = look_at((0.85, -0.45, 0.35), (0.5, 0.0, 0.03), size=(480, 640), vertical_fov=0.5)
        frame = SceneView(camera=camera).render(Drawables.of(objects), beads, box)
        write_png(out, frame)
        print(f"wrote {out}")
    return beads


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, help="picture of the scene at rest (PNG)")
    quiet_warp()
    main(parser.parse_args().out)
