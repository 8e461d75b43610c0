"""A video of recorded control at a fixed rate: the states of its rows, and the arm at the tip.

Episodes of several folders with the same seed are shown beside each other, from the same moment on:
a trajectory and what became of it, for example.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..control.control_task import ControlTask
from ..episodes import Episode, EpisodeReader, Step
from ..errors import InputError, WarpDeformError
from ..objects.colors import TARGET
from ..rendering.camera import Camera, look_at
from ..rendering.caption import Caption
from ..rendering.scene_view import ArmMeshes, SceneView
from ..rendering.video import VideoWriter
from ..worlds.worlds import Worlds
from .control_episodes import control_worlds
from .control_replay import setup_of
from .video import FPS, LONGEST, STILL_SECONDS
from .workers import single_threaded

__all__ = ["film_control", "film_control_episodes"]

_MARK_RADIUS = 0.006
"""Of the points of a goal [m]."""


@dataclass(frozen=True, eq=False)
class _Panel:
    """One episode as it is shown.

    Attributes:
        name: what it is, beside others; empty where it is alone
        rate: rows a second
    """

    name: str
    steps: tuple[Step, ...]
    rate: float

    @property
    def seconds(self) -> float:
        """From the first row to the last."""
        return (len(self.steps) - 1) / self.rate

    def row(self, time: float) -> int:
        """The row so long after the first one; the last one stays."""
        return min(int(time * self.rate + 1e-6), len(self.steps) - 1)


def film_control(
    folders: Sequence[Path],
    path: Path,
    *,
    seeds: Sequence[int],
    names: Sequence[str] = ("",),
    size: tuple[int, int] = (540, 960),
) -> None:
    """Write an MP4 of episodes, one after the other; those of several folders beside each other.

    Args:
        names: of the folders, one each
        size: rows and columns of a frame of one folder

    Raises:
        InputError: the path does not end with .mp4 or cannot be written, an episode is missing or
            none of control at a fixed rate.
        WarpDeformError: the start of an episode comes out differently here.
    """
    readers = [EpisodeReader(folder, control=True) for folder in folders]
    shown = [[reader.read(seed) for reader in readers] for seed in seeds]
    film_control_episodes(shown, path, names=names, size=size)


def film_control_episodes(
    shown: Sequence[Sequence[Episode]],
    path: Path,
    *,
    names: Sequence[str] = ("",),
    size: tuple[int, int] = (540, 960),
) -> None:
    """Write an MP4 of episodes in memory: one after the other, those of one seed beside each other.

    Args:
        names: of the episodes of a seed, one each
        size: rows and columns of a frame of one episode

    Raises:
        InputError: the path does not end with .mp4 or cannot be written, or an episode is none of
            control at a fixed rate.
        WarpDeformError: the start of an episode comes out differently here.
    """
    scenes = [
        [_panel(name, episode) for name, episode in zip(names, episodes, strict=True)]
        for episodes in shown
    ]
    lengths = [max(panel.seconds for panel in panels) for panels in scenes]
    speed = max(1.0, sum(lengths) / (LONGEST - 2 * STILL_SECONDS * len(scenes)))
    still = round(STILL_SECONDS * FPS)
    with single_threaded(), VideoWriter(path, FPS) as video:
        for episodes, panels, length in zip(shown, scenes, lengths, strict=True):
            seed = episodes[0].info.seed
            worlds = _begun(episodes[0])
            # a view goes on from the frame that it drew before
            stages = [_Stage(worlds, size) for _ in panels]
            times = np.arange(0.0, length + speed / FPS, speed / FPS)
            for time in (*[0.0] * still, *times, *[length] * still):
                parts = [
                    stage.draw(panel, time, seed, speed)
                    for stage, panel in zip(stages, panels, strict=True)
                ]
                video.write(np.concatenate(parts, axis=1))


def _panel(name: str, episode: Episode) -> _Panel:
    record = episode.info.control
    if record is None:
        raise InputError(
            f"the episode of seed {episode.info.seed} is no control at a fixed rate, which this "
            "video shows"
        )
    return _Panel(name, episode.steps, record.rate)


def _begun(episode: Episode) -> Worlds:
    """Worlds whose slot 0 has the scene of an episode at its start."""
    control = control_worlds(setup_of(episode.info))
    control.reset({0: episode.info.seed})
    if control.worlds.hash(0) != episode.steps[0].state_hash:
        raise WarpDeformError(
            f"the start of seed {episode.info.seed} comes out differently here, so its video would "
            "show another scene; `warp-deform replay --verify` compares everything"
        )
    return control.worlds


def _swing_camera(size: tuple[int, int]) -> Camera:
    """As `scene_camera`, with room above for an arm that is stretched upwards."""
    return look_at((1.5, -0.8, 1.0), (0.4, -0.03, 0.36), size=size, vertical_fov=0.95)


class _Stage:
    """Draws states of one scene, with the arm where the tip is."""

    def __init__(self, worlds: Worlds, size: tuple[int, int]) -> None:
        self._worlds, self._rows = worlds, size[0]
        task = worlds.task
        swung = isinstance(task, ControlTask) and task.held_particle is not None
        self._view = SceneView(size, camera=_swing_camera(size) if swung else None)
        self._meshes = ArmMeshes(worlds.robot.meshes())
        self._q = worlds.robot.home_q
        self._scene = worlds.episodes[0].drawables
        marks = np.zeros((0, 3))
        if isinstance(task, ControlTask):
            marks = task.marks(worlds.episodes[0].layout)
        self._marks = marks
        if len(marks):
            count = len(worlds.episodes[0].snapshot.particle_q)
            self._scene = self._scene.marked(count, len(marks), _MARK_RADIUS, TARGET)

    def draw(self, panel: _Panel, time: float, seed: int, speed: float) -> np.ndarray:
        """The frame (rows, columns, 3) uint8 of a panel so long after its first row."""
        robot, t = self._worlds.robot, panel.row(time)
        step = panel.steps[t]
        assert step.control is not None, "rows of control have a tip"
        found = robot.solve_top_down(step.control.tip[None])
        # out of its reach the arm waits where it was
        self._q = found.q[0] if found.reached[0] else self._q
        frame = self._view.render(
            self._scene,
            np.concatenate([step.particle_q, self._marks]).astype(np.float32),
            step.body_q,
            self._meshes.at(robot.link_poses(self._q)),
        )
        fast = f"   {speed:.1f} x" if speed > 1.05 else ""
        title = f"{self._worlds.task.name}{', ' * bool(panel.name)}{panel.name}"
        doing = f"{t / panel.rate:.2f} s   score {step.score:.2f}{fast}"
        Caption(self._rows, lines=(title, doing, f"seed {seed}")).draw(frame)
        return frame
