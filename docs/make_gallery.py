"""Makes the gallery: every kind of object in a moment of a task, from above and from the side.

python docs/make_gallery.py docs/images
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from warp_deform.rendering.camera import look_at
from warp_deform.rendering.pixels import SHAPE, world_to_pixel
from warp_deform.rendering.scene_view import SceneView
from warp_deform.rendering.topdown import TopDown
from warp_deform.rendering.video import write_png
from warp_deform.worlds import Worlds
from warp_deform.worlds.episode import DEMONSTRATOR_STREAM, episode_rng

TILE = 300  # [pixels]
HALF = 48  # [pixels] of the picture from above, which is enlarged
SIDE = (300, 400)


@dataclass(frozen=True)
class Moment:
    """What to show: an episode after so many actions, or a share of the way through the next."""

    label: str
    task: str
    seed: int
    actions: int = 0
    during: float | None = None


PICTURES = {
    "gallery_cables.png": (
        Moment("cable", "cable-shape", 0),
        Moment("ring", "cable-ring", 1),
        Moment("L-block", "block-notarget", 0),
    ),
    "gallery_fabrics.png": (
        Moment("fabric", "fabric-flat", 0),
        Moment("pulled over a cube", "fabric-cover", 1, actions=1, during=0.55),
        Moment("cube covered", "fabric-cover", 1, actions=2),
    ),
    "gallery_bags.png": (
        Moment("bag", "bag-alone-open", 1),
        Moment("opened", "bag-alone-open", 1, actions=8),
        Moment("cube in the bag", "bag-items-1", 3, actions=1),
        Moment("carried by a bead", "bag-items-1", 3, actions=1, during=0.55),
    ),
}


def main(folder: Path) -> None:
    """Simulate every moment and write the pictures."""
    for name, moments in PICTURES.items():
        tiles = [draw(moment) for moment in moments]
        write_png(folder / name, np.concatenate(tiles, axis=0))


def draw(moment: Moment) -> np.ndarray:
    """The moment from above and from the side, with its label."""
    worlds = Worlds(moment.task)
    worlds.reset({0: moment.seed})
    rng = episode_rng(moment.seed, DEMONSTRATOR_STREAM)
    episode = worlds.episodes[0]
    for _ in range(moment.actions):
        if worlds.solved(0):
            break
        worlds.step({0: _action(worlds, rng)})
    particle_q, body_q = episode.snapshot.particle_q, episode.snapshot.body_q
    if moment.during is not None:
        frames = worlds.step({0: _action(worlds, rng)}, record=0.02)[0].frames
        assert frames is not None
        at = int(moment.during * (len(frames.times) - 1))
        particle_q, body_q = frames.particle_q[at], frames.body_q[at]
    middle = (particle_q if len(particle_q) else body_q)[:, :3].mean(axis=0)
    images = TopDown().render(episode.drawables, particle_q, body_q)
    row, column = np.clip(world_to_pixel(middle[:2]), HALF, np.array(SHAPE) - HALF)
    above = images.color[row - HALF : row + HALF, column - HALF : column + HALF]
    above = cv2.resize(above, (TILE, TILE), interpolation=cv2.INTER_CUBIC)
    x, y, z = (float(v) for v in middle)
    camera = look_at((x + 0.42, y - 0.3, z + 0.22), (x, y, z), size=SIDE, vertical_fov=0.62)
    side = SceneView(SIDE, camera=camera).render(episode.drawables, particle_q, body_q)
    tile = np.ascontiguousarray(np.concatenate([above, side], axis=1))
    for color, width in (((20, 20, 20), 4), ((255, 255, 255), 1)):
        cv2.putText(
            tile, moment.label, (10, 28), cv2.FONT_HERSHEY_SIMPLEX, 0.7, color, width, cv2.LINE_AA
        )
    return tile


def _action(worlds: Worlds, rng: np.random.Generator) -> np.ndarray:
    episode = worlds.episodes[0]
    action = worlds.task.demonstrate_visible(episode.layout, episode.snapshot, rng)
    assert action is not None
    return action


if __name__ == "__main__":
    main(Path(sys.argv[1]))
