"""A video of recorded episodes: simulated again, with the arm that moves through its waypoints."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..episodes import Episode, EpisodeReader, Goal
from ..errors import InputError, WarpDeformError
from ..rendering.caption import Caption
from ..rendering.scene_view import ArmMeshes, SceneView
from ..rendering.video import VideoWriter
from ..worlds.arm_path import ArmPath
from ..worlds.loop import worlds_for
from ..worlds.worlds import Worlds
from .recording import recorded_task
from .replay import Recording
from .workers import single_threaded

__all__ = ["Take", "TakeRow", "check_video", "film", "film_takes", "seen"]

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


@dataclass(frozen=True, eq=False, kw_only=True)
class Take:
    """An episode as it was played: enough to simulate it again, and what its frames tell.

    Attributes:
        goal: the one it was given, None where the start makes it
        actions: (7,) each
        rows: at the start and after every action, what was seen and came of it
    """

    task: str
    robot: str
    seed: int
    goal: Goal | None
    actions: tuple[np.ndarray, ...]
    rows: tuple[TakeRow, ...]
    sim_seconds: float


@dataclass(frozen=True, eq=False)
class TakeRow:
    """One state: its hash, its score, and the picture (h, w, 3) uint8 that a policy sees."""

    state_hash: str
    score: float
    seen: np.ndarray


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

    Args:
        size: rows and columns of a frame

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
    recording = Recording(reader)
    film_takes([_take(recording, reader.read(seed)) for seed in chosen], path, size=size)


def film_takes(takes: Sequence[Take], path: Path, *, size: tuple[int, int] = (540, 960)) -> None:
    """Write an MP4 of episodes, one after the other; see `film`."""
    length = LONGEST - 2 * STILL_SECONDS * len(takes)
    speed = max(1.0, sum(take.sim_seconds for take in takes) / length)
    view = SceneView(size)
    with single_threaded(), VideoWriter(path, FPS) as video:
        for take in takes:
            worlds = worlds_for(take.task, take.robot)
            robot = worlds.robot
            arm = ArmMeshes(robot.meshes())
            captions = [
                Caption(size[0], lines=_caption(take, t, speed), inset=row.seen)
                for t, row in enumerate(take.rows)
            ]
            for shot in _shots(worlds, take, speed):
                frame = view.render(
                    worlds.episodes[0].drawables,
                    shot.particle_q,
                    shot.body_q,
                    arm.at(robot.link_poses(shot.q)),
                )
                captions[shot.row].draw(frame)
                video.write(frame)


def _take(recording: Recording, episode: Episode) -> Take:
    info = episode.info
    return Take(
        task=info.task,
        robot=info.robot,
        seed=info.seed,
        goal=recording.goal(info.seed),
        actions=tuple(s.action for s in episode.steps if s.action is not None),
        rows=tuple(
            TakeRow(s.state_hash, s.score, seen(s.color, episode.goal)) for s in episode.steps
        ),
        sim_seconds=info.sim_seconds,
    )


def _shots(worlds: Worlds, take: Take, speed: float) -> Iterator[_Shot]:
    """Every frame of an episode, while it is simulated again in slot 0."""
    worlds.reset({0: take.seed}, goals={} if take.goal is None else {0: take.goal})
    _check(worlds, take, 0)
    interval = speed / FPS
    still = round(STILL_SECONDS * FPS)
    waiting = worlds.robot.home_q
    for t, action in enumerate(take.actions):
        start = worlds.episodes[0].snapshot
        report = worlds.step({0: action}, record=interval)[0]
        _check(worlds, take, t + 1)
        arm = ArmPath(report, waiting)
        waiting = arm.at(arm.seconds)
        if t == 0 or report.frames is None:
            yield from [_Shot(start.particle_q, start.body_q, arm.at(0.0), t)] * still
        end = worlds.episodes[0].snapshot
        frames = report.frames
        if frames is None:  # what a policy asks for may be out of the robot's reach
            continue
        for time, particle_q, body_q in zip(
            frames.times, frames.particle_q, frames.body_q, strict=True
        ):
            yield _Shot(particle_q, body_q, arm.at(time), t)
        for time in np.arange(frames.times[-1] + interval, arm.seconds, interval):
            yield _Shot(end.particle_q, end.body_q, arm.at(time), t)
    yield from [_Shot(end.particle_q, end.body_q, arm.at(arm.seconds), t + 1)] * still


def _check(worlds: Worlds, take: Take, t: int) -> None:
    """Raise unless the simulated state is the one of row t."""
    if worlds.hash(0) != take.rows[t].state_hash:
        raise WarpDeformError(
            f"row {t} of seed {take.seed} comes out differently here, so its video would "
            "show something else; `warp-deform replay --verify` compares everything"
        )


def _caption(take: Take, row: int, speed: float) -> tuple[str, ...]:
    total = len(take.actions)
    doing = f"action {row + 1} of {total}" if row < total else "done"
    fast = f"   {speed:.1f} x" if speed > 1.05 else ""
    return take.task, f"{doing}   score {take.rows[row].score:.2f}{fast}", f"seed {take.seed}"


def seen(color: np.ndarray, goal: Goal | None) -> np.ndarray:
    """What a policy sees: the top-down picture, beside the goal's where there is one."""
    if goal is None:
        return color
    gap = np.full((len(color), 4, 3), 255, np.uint8)
    return np.concatenate([color, gap, goal.color], axis=1)
