"""A video of recorded episodes: simulated again, with the arm that moves through its way-points."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .episode_loop import worlds_for
from .episodes import Episode, EpisodeReader
from .errors import InputError, WarpDeformError
from .recording import recorded_task
from .rendering.caption import annotate
from .rendering.scene_view import ArmMeshes, SceneView
from .rendering.video import VideoWriter
from .replay import Recording
from .running import StepReport
from .workers import single_threaded
from .worlds import Worlds

__all__ = ["check_video", "film"]

FPS = 24
LONGEST = 20.0
"""Length of a video [s]: longer episodes are shown faster, and the picture says how much."""
STILL_SECONDS = 0.7
"""The first and the last state of an episode stay for so long in the video [s]."""


@dataclass(frozen=True, eq=False)
class _Shot:
    """What one frame shows: a state, joint positions (dof,) [rad], and the row it comes after."""

    particle_q: np.ndarray
    body_q: np.ndarray
    q: np.ndarray
    row: int


def check_video(path: Path) -> None:
    """Make the folder of `path` where it is missing; InputError unless a video can be written."""
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"no video can be written to {path}: {error.strerror}") from error
    VideoWriter(path, FPS)


def film(
    folder: Path,
    path: Path,
    *,
    seeds: Sequence[int] | None = None,
    size: tuple[int, int] = (540, 960),
) -> None:
    """Write an MP4 of episodes of a folder, by default the first; the arm is the recorded one.

    The states are simulated again, not stored, and have to be the recorded ones bit by bit.
    size: rows and columns of a frame.

    Raises:
        InputError: the path does not end with .mp4 or cannot be written, or there is no episode.
        WarpDeformError: the simulation differs from the recording.
    """
    reader = EpisodeReader(folder)
    chosen = reader.seeds[:1] if seeds is None else seeds
    if not len(chosen):
        raise InputError(f"{path} would show no episode; name at least one seed")
    infos = [reader.info(seed) for seed in chosen]
    for info in infos:
        if not info.actions:
            raise InputError(f"{reader.path(info.seed)} has no action that could be shown")
        recorded_task(info)
    length = LONGEST - 2 * STILL_SECONDS * len(infos)
    speed = max(1.0, sum(info.sim_seconds for info in infos) / length)
    view = SceneView(size)
    with single_threaded(), VideoWriter(path, FPS) as video:
        for info in infos:
            worlds = worlds_for(info.task, info.robot)
            episode, robot = reader.read(info.seed), worlds.robot
            arm = ArmMeshes(robot.meshes())
            inset: tuple[int, np.ndarray | None] = -1, None
            for shot in _shots(worlds, Recording(reader), episode, speed):
                if shot.row != inset[0]:
                    inset = shot.row, _seen(episode, shot.row)
                links = arm.at(robot.link_poses(shot.q))
                drawables = worlds.episodes[0].drawables
                frame = view.render(drawables, shot.particle_q, shot.body_q, links)
                lines = _caption(episode, shot.row, speed)
                video.write(annotate(frame, lines=lines, inset=inset[1]))


def _shots(worlds: Worlds, recording: Recording, episode: Episode, speed: float) -> Iterator[_Shot]:
    """Every frame of an episode, while it is simulated again in slot 0."""
    seed = episode.info.seed
    goal = recording.goal(seed)
    worlds.reset({0: seed}, goals={} if goal is None else {0: goal})
    _check(worlds, episode, 0)
    interval = speed / FPS
    still = round(STILL_SECONDS * FPS)
    waiting = worlds.robot.home_q
    for t, step in enumerate(episode.steps[:-1]):
        start = worlds.episodes[0].snapshot
        assert step.action is not None
        report = worlds.step({0: step.action}, record=interval)[0]
        _check(worlds, episode, t + 1)
        arm = _ArmPath(report, waiting)
        waiting = arm.at(arm.seconds)
        if t == 0:
            yield from [_Shot(start.particle_q, start.body_q, arm.at(0.0), t)] * still
        assert report.frames is not None
        frames = report.frames
        for time, particle_q, body_q in zip(
            frames.times, frames.particle_q, frames.body_q, strict=True
        ):
            yield _Shot(particle_q, body_q, arm.at(time), t)
        end = worlds.episodes[0].snapshot
        for time in np.arange(frames.times[-1] + interval, arm.seconds, interval):
            yield _Shot(end.particle_q, end.body_q, arm.at(time), t)
    yield from [_Shot(end.particle_q, end.body_q, arm.at(arm.seconds), t + 1)] * still


class _ArmPath:
    """Joint positions during one action: along its motions, from where the last one ended."""

    def __init__(self, report: StepReport, waiting: np.ndarray) -> None:
        times, joints = [np.zeros(1)], [waiting[None]]
        begin = 0.0
        for motion, q in zip(report.motions, report.joints, strict=True):
            if q is None:  # out of reach: the arm stays where it is
                break
            times.append(begin + motion.times)
            joints.append(q)
            begin += motion.seconds
        first = 1 if len(times) > 1 else 0  # the motions begin where the arm waits
        self._times, self._joints = np.concatenate(times[first:]), np.concatenate(joints[first:])
        self.seconds = begin

    def at(self, time: float) -> np.ndarray:
        """Joint positions (dof,) [rad] at a time from the beginning of the action [s]."""
        return np.array([np.interp(time, self._times, q) for q in self._joints.T])


def _check(worlds: Worlds, episode: Episode, t: int) -> None:
    """Raise unless the simulated state is the recorded one of row t."""
    if worlds.hash(0) != episode.steps[t].state_hash:
        raise WarpDeformError(
            f"row {t} of seed {episode.info.seed} comes out differently here, so its video would "
            "show something else; `warp-deform replay --verify` compares everything"
        )


def _caption(episode: Episode, row: int, speed: float) -> tuple[str, ...]:
    info, step = episode.info, episode.steps[row]
    doing = f"action {row + 1} of {info.actions}" if row < info.actions else "done"
    fast = f"   {speed:.1f} x" if speed > 1.05 else ""
    return info.task, f"{doing}   score {step.score:.2f}{fast}", f"seed {info.seed}"


def _seen(episode: Episode, row: int) -> np.ndarray:
    """What a policy sees in a row: the top-down picture, beside the goal's where there is one."""
    color = episode.steps[row].color
    if episode.goal is None:
        return color
    gap = np.full((len(color), 4, 3), 255, np.uint8)
    return np.concatenate([color, gap, episode.goal.color], axis=1)
