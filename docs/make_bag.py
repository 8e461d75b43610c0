"""Makes the moving picture of the first page of the docs: a bag is opened, filled and carried.

    python docs/make_bag.py docs/images/bag-items-1.webp

The `visible` demonstrator plays `bag-items-1`. The picture loops.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from warp_deform.rendering.camera import look_at
from warp_deform.rendering.scene_view import ArmMeshes, SceneView
from warp_deform.worlds import Worlds
from warp_deform.worlds.episode import DEMONSTRATOR_STREAM, StepReport, episode_rng

SEED = 6
SIZE = (320, 480)  # rows and columns [pixels]
FPS, SPEED = 15, 1.25
LAST_SECONDS, QUALITY = 1.5, 78
DOING = {0.05: "open", 0.30: "fill", 0.40: "carry"}
"""By the lift of an action [m]: bag-items has a stage of its own for each."""


def main(path: Path) -> None:
    """Play the episode and write what it looks like."""
    camera = look_at((1.17, -0.42, 0.68), (0.47, 0.09, 0.13), size=SIZE, vertical_fov=0.59)
    view = SceneView(SIZE, camera=camera, supersample=3)
    worlds = Worlds("bag-items-1")
    arm = ArmMeshes(worlds.robot.meshes())
    worlds.reset({0: SEED})
    frames = []
    for text, report in actions(worlds):
        assert report.frames is not None
        drawables = worlds.episodes[0].drawables
        times, joints = joints_of(report)
        seen = report.frames
        # the arm may still retreat when everything rests: the last state stays until it is there
        late = np.arange(seen.times[-1], times[-1], SPEED / FPS)[1:]
        last = [len(seen.times) - 1] * len(late)
        for i, time in zip([*range(len(seen.times)), *last], [*seen.times, *late], strict=True):
            q = np.array([np.interp(time, times, column) for column in joints.T])
            links = arm.at(worlds.robot.link_poses(q))
            frame = view.render(drawables, seen.particle_q[i], seen.body_q[i], links).copy()
            cv2.putText(frame, text, (12, 32), cv2.FONT_HERSHEY_SIMPLEX, 0.8, (45, 47, 50), 2,
                        cv2.LINE_AA)  # fmt: skip
            frames.append(frame)
    if not (worlds.solved(0) and worlds.enclosed(0)):
        sys.exit(f"seed {SEED} is no longer an episode to show: choose another")
    write_webp(path, frames)


def actions(worlds: Worlds) -> Iterator[tuple[str, StepReport]]:
    """What every action of the episode is for, and what came of it."""
    rng = episode_rng(SEED, DEMONSTRATOR_STREAM)
    while not worlds.episodes[0].ended:
        episode = worlds.episodes[0]
        action = worlds.task.demonstrate_visible(episode.layout, episode.snapshot, rng)
        assert action is not None
        yield DOING[round(float(action[6]), 2)], worlds.step({0: action}, record=SPEED / FPS)[0]


def joints_of(report: StepReport) -> tuple[np.ndarray, np.ndarray]:
    """Times (T,) [s] of an action, and the arm's joint positions (T, dof) [rad] then."""
    times, joints, begin = [], [], 0.0
    for motion, q in zip(report.motions, report.joints, strict=True):
        assert q is not None
        times.append(begin + motion.times)
        joints.append(q)
        begin += motion.seconds
    return np.concatenate(times), np.concatenate(joints)


def write_webp(path: Path, frames: list[np.ndarray]) -> None:
    """Write frames (H, W, 3) uint8 RGB as a picture that loops."""
    film = cv2.Animation()
    film.frames = [cv2.cvtColor(frame, cv2.COLOR_RGB2BGR) for frame in frames]
    film.durations = np.full(len(frames), 1000 // FPS, np.int32)
    film.durations[-1] = round(1000 * LAST_SECONDS)
    if not cv2.imwriteanimation(str(path), film, [cv2.IMWRITE_WEBP_QUALITY, QUALITY]):
        sys.exit(f"{path} cannot be written")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
