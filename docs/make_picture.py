"""Makes the README's picture: a frame from the middle of an action, and what the policy sees.

python docs/make_picture.py docs/images/cable-shape.png
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from warp_deform.rendering.camera import look_at
from warp_deform.rendering.caption import annotate
from warp_deform.rendering.scene_view import ArmMeshes, SceneView
from warp_deform.rendering.video import write_png
from warp_deform.worlds import Worlds
from warp_deform.worlds.episode import DEMONSTRATOR_STREAM, episode_rng

SEED, ACTION, SHARE = 0, 2, 0.62
SIZE = (600, 1200)


def main(path: Path) -> None:
    """Simulate up to the action, and draw a moment of it."""
    worlds = Worlds("cable-shape")
    worlds.reset({0: SEED})
    rng = episode_rng(SEED, DEMONSTRATOR_STREAM)
    for _ in range(ACTION + 1):
        episode = worlds.episodes[0]
        before = episode.snapshot
        action = worlds.task.demonstrate(episode.layout, before, rng)
        assert action is not None
        report = worlds.step({0: action}, record=0.05)[0]
    carry, joints = report.motions[1], report.joints[1]
    assert joints is not None and report.frames is not None
    time = SHARE * carry.seconds
    frame = int(np.searchsorted(report.frames.times, report.motions[0].seconds + time))
    q = np.array([np.interp(time, carry.times, column) for column in joints.T])
    camera = look_at((1.12, -0.42, 0.62), (0.42, -0.02, 0.1), size=SIZE, vertical_fov=0.62)
    picture = SceneView(SIZE, camera=camera).render(
        episode.drawables,
        report.frames.particle_q[frame],
        report.frames.body_q[frame],
        ArmMeshes(worlds.robot.meshes()).at(worlds.robot.link_poses(q)),
    )
    write_png(path, annotate(picture, inset=before.images.color))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
