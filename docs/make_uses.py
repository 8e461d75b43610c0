"""Draws what the two examples of gradients find, from the guess to the result.

python docs/make_uses.py docs/images
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from warp_deform.objects.cable import Cable
from warp_deform.objects.colors import BLUE, ORANGE, Color
from warp_deform.objects.zone import segment_zone
from warp_deform.quiet import quiet_warp
from warp_deform.rendering.camera import look_at
from warp_deform.rendering.caption import annotate
from warp_deform.rendering.drawables import Drawables
from warp_deform.rendering.scene_view import SceneView
from warp_deform.rendering.video import write_png

sys.path.insert(0, str(Path(__file__).parent.parent / "examples"))

import identify_cable
import straighten_cable

SIZE = (300, 400)
NO_BODIES = np.zeros((0, 7), np.float32)


def draw_identification(path: Path) -> None:
    """Three moments of the recording in orange, half and half with a simulation in blue."""
    pull = identify_cable.Pull()
    seen = identify_cable.record(pull)
    camera = look_at((0.63, -0.17, 0.42), (0.48, 0.08, 0.08), size=SIZE, vertical_fov=0.62)
    view = SceneView(camera=camera)
    looks = [Drawables.of([_of_one_color(pull.cord, color)]) for color in (BLUE, ORANGE)]
    rows = []
    for label, values in (
        ("recorded and guess", identify_cable.GUESS),
        ("recorded and found", identify_cable.fit(pull, seen)),
    ):
        x = pull.simulate(values)[0]
        tiles = [
            cv2.addWeighted(
                view.render(looks[0], x[t], NO_BODIES),
                0.5,
                view.render(looks[1], seen[0, t], NO_BODIES),
                0.5,
                0,
            )
            for t in (4, 10, 14)
        ]
        tiles[0] = annotate(tiles[0], lines=[label])
        rows.append(np.hstack(tiles))
    write_png(path, np.vstack(rows))


def draw_straightening(path: Path) -> None:
    """The folded cable, after a straight pull, and after the one found; the line in green."""
    pull, line = straighten_cable.Pull(), straighten_cable.LINE
    camera = look_at((0.95, -0.1, 0.62), (0.5, -0.1, 0.0), size=SIZE, vertical_fov=0.55)
    view, goal = SceneView(camera=camera), segment_zone(line[[0, -1], :2], width=0.006)
    tiles = [_tile(view, [pull.cable, goal], straighten_cable.FOLDS, "before")]
    for label, knots in (
        ("after a straight pull", straighten_cable.DIRECT),
        ("after the pull found", straighten_cable.descend(pull, straighten_cable.DETOUR)),
    ):
        trace = segment_zone(knots, width=0.003)
        drawn = [pull.cable, goal, replace(trace, color=ORANGE)]
        tiles.append(_tile(view, drawn, pull.simulate(knots), label))
    write_png(path, np.hstack(tiles))


def _tile(view: SceneView, drawn: list, beads: np.ndarray, label: str) -> np.ndarray:
    return annotate(view.render(Drawables.of(drawn), beads, NO_BODIES), lines=[label])


def _of_one_color(cable: Cable, color: Color) -> Cable:
    look = {"color": color, "first_color": color, "last_color": color}
    return replace(cable, config=replace(cable.config, visual_radius=0.006, **look))


if __name__ == "__main__":
    quiet_warp()
    draw_identification(Path(sys.argv[1]) / "identify_cable.png")
    draw_straightening(Path(sys.argv[1]) / "straighten_cable.png")
