"""Pictures of environments for people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.error import ResetNeeded

from ..errors import InputError
from ..rendering.scene_view import ArmMeshes, SceneView
from ..worlds.worlds import Worlds

__all__ = ["WorldsView", "check_render_mode"]

_FRAME = (360, 640)  # [pixels] rows, columns


class WorldsView:
    """Draws slots of `worlds` for people.

    Args:
        arm_follows: whether the arm is where the tip is; else it is in its home posture
    """

    def __init__(self, worlds: Worlds, *, arm_follows: bool = False) -> None:
        self._worlds, self._follows = worlds, arm_follows
        self._scene: SceneView | None = None

    def frame(self, slot: int) -> np.ndarray:
        """Picture (360, 640, 3) uint8 of a slot."""
        robot = self._worlds.robot
        if self._scene is None:
            self._scene = SceneView(_FRAME)
            self._meshes = ArmMeshes(robot.meshes())
            self._home = self._meshes.at(robot.link_poses(robot.home_q))
        episode = self._worlds.episodes[slot]
        state = episode.snapshot.particle_q, episode.snapshot.body_q
        if not all(np.isfinite(array).all() for array in state):
            return np.zeros((*_FRAME, 3), np.uint8)
        links = self._home
        if self._follows:
            found = robot.solve_top_down(episode.tip[None])
            links = self._meshes.at(robot.link_poses(found.q[0])) if found.reached[0] else links
        return self._scene.render(episode.drawables, *state, links)

    def render(self, mode: str | None) -> np.ndarray | None:
        """What `render` of a lone environment returns: slot 0, or None without a render mode.

        Raises:
            gymnasium.error.ResetNeeded: no episode was begun.
        """
        if mode is None:
            return None
        if not self._worlds.episodes:
            raise ResetNeeded("nothing to draw: call reset() first")
        return self.frame(0)


def check_render_mode(mode: str | None, metadata: Mapping[str, Any]) -> str | None:
    """The mode; InputError when it is unknown."""
    if mode is not None and mode not in metadata["render_modes"]:
        raise InputError(f"render_mode is None or 'rgb_array', not {mode!r}")
    return mode
