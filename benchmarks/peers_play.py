"""A play of any engine on any scene: where everything was at every frame, and what it cost."""

from __future__ import annotations

import time
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from peers_ours import play_ours
from peers_settings import LANES, STARTS, fine

from warp_deform.peers import PEER_SCENES, SoftScene, peer_scene, soft_scene
from warp_deform.peers.mujoco_peer import MujocoWorld
from warp_deform.peers.mujoco_soft import MujocoSoftWorld
from warp_deform.peers.newton_peer import NewtonWorld
from warp_deform.peers.newton_soft import NewtonSoftWorld
from warp_deform.peers.pybullet_peer import PyBulletWorld
from warp_deform.peers.pybullet_soft import PyBulletSoftWorld

__all__ = ["fine_tracks", "play", "starts_of"]

FRAME_RATE = 60
CACHE = Path(__file__).parents[1] / "build" / "peers"
WORLDS = {
    "mujoco": (MujocoWorld, MujocoSoftWorld),
    "newton-vbd": (NewtonWorld, NewtonSoftWorld),
    "newton-xpbd": (NewtonWorld, None),
    "pybullet": (PyBulletWorld, PyBulletSoftWorld),
}
"""Of cables and blocks, and of fabrics and bags."""


def starts_of(scene: str, count: int | None = None) -> list[Any]:
    """The starts that every engine plays."""
    make = peer_scene if scene in PEER_SCENES else soft_scene
    return [make(scene, seed=seed) for seed in range(count or STARTS[scene])]


def play(
    engine: str,
    scene: str,
    settings: Any,
    *,
    record: bool = True,
    most: float = np.inf,
    count: int | None = None,
) -> tuple[np.ndarray, float]:
    """Positions (starts, frames, n, 3) [m], and CPU ms per simulated second and world.

    A play that has cost more than `most` CPU seconds, or is no longer finite, ends with frames that
    are not numbers.

    Args:
        record: whether ours keeps its frames, which costs; its worlds in lanes are always as many
            as there are lanes
        count: of starts; None: as many as the scene has
    """
    if engine == "ours":
        lanes = settings.lanes > 1
        starts = starts_of(scene, LANES if lanes else count)
        tracks, cost = play_ours(starts, settings, record=record)
        return tracks[: STARTS[scene]], cost
    starts = starts_of(scene, count)
    tracks, spent, seconds = [], 0.0, 0.0
    for start in starts:
        soft = isinstance(start, SoftScene)
        with closing(WORLDS[engine][soft](start, settings)) as world:
            track, cpu = _frames(world, start, most / len(starts))
        seen = [len(track), len(track[0])]
        whole = round(FRAME_RATE * _seconds(start))
        tracks.append(np.full((whole, *np.shape(track[0])), np.nan))
        tracks[-1][: seen[0]] = track
        spent += cpu
        seconds += seen[0] / FRAME_RATE
    return np.array(tracks), 1e3 * spent / seconds


def _seconds(start: Any) -> float:
    return start.before + start.held + start.after if isinstance(start, SoftScene) else 1.0


def _frames(world: Any, start: Any, most: float) -> tuple[list[np.ndarray], float]:
    """Positions after every frame, and CPU seconds; the vertex that is held follows its path."""
    soft = isinstance(start, SoftScene)
    look = world.vertices if soft else world.beads
    take = round(FRAME_RATE * start.before) if soft else -1
    leave = take + round(FRAME_RATE * start.held) if soft else -1
    knots, track, spent = None, [], 0.0
    for k in range(round(FRAME_RATE * _seconds(start))):
        if k == take < leave:
            knots = start.knots + look()[0]
            world.hold()
        if k == leave > take:
            world.release()
        arguments = ()
        if knots is not None and k < leave:
            at = (k + 1 - take) / FRAME_RATE
            arguments = (np.array([np.interp(at, start.times, axis) for axis in knots.T]),)
        before = time.process_time()
        world.frame(*arguments)
        spent += time.process_time() - before
        track.append(look())
        if spent > most or not np.isfinite(track[-1]).all():
            break
    return track, spent


def fine_tracks(engine: str, scene: str) -> np.ndarray:
    """Of the engine's own fine solution; computed once, and kept in `build/peers`."""
    path = CACHE / f"{engine}-{scene}.npy"
    if not path.exists():
        CACHE.mkdir(parents=True, exist_ok=True)
        tracks, _ = play(engine, scene, fine(engine, scene))
        np.save(path, tracks)
    return np.load(path)
