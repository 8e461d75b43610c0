"""Makes the moving picture of a recorded episode on the robot or its twin.

    python docs/make_rehearsal.py franka-episodes/EPISODE docs/images/rehearsal.webp

What the camera saw, and the same from above with the plan and the goal, after every action.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

from hardware.cameras.camera import read_image
from hardware.recordings.recording import Recording

HEIGHT = 480  # [pixels]
SECONDS, LAST_SECONDS = 1.2, 3.0


def frame(folder: Path, index: int, overlap: float) -> np.ndarray:
    """One look: camera, plan, and the overlap in words, (h, w, 3) uint8 RGB."""
    sides = []
    for name in ("rgb", "overlay"):
        picture = read_image(folder / "frames" / f"{index:03d}_{name}.png", color=True)
        width = round(picture.shape[1] * HEIGHT / picture.shape[0])
        sides.append(cv2.resize(picture, (width, HEIGHT), interpolation=cv2.INTER_AREA))
    image = np.hstack(sides)
    text = f"after {index} actions: overlap {overlap:.2f}"
    cv2.putText(
        image,
        text,
        (12, HEIGHT - 16),
        cv2.FONT_HERSHEY_SIMPLEX,
        0.7,
        (255, 255, 255),
        1,
        cv2.LINE_AA,
    )
    return image


def main() -> None:
    """The picture of the episode that the command names."""
    folder, out = map(Path, sys.argv[1:3])
    seen = Recording.read(folder).observations
    frames = [frame(folder, i, each["iou"]) for i, each in enumerate(seen)]
    film = cv2.Animation()
    film.frames = [cv2.cvtColor(each, cv2.COLOR_RGB2BGR) for each in frames]
    seconds = [SECONDS] * (len(frames) - 1) + [LAST_SECONDS]
    film.durations = np.array([round(1e3 * each) for each in seconds], np.int32)
    if not cv2.imwriteanimation(str(out), film, [cv2.IMWRITE_WEBP_QUALITY, 60]):
        sys.exit(f"{out} cannot be written")


if __name__ == "__main__":
    main()
