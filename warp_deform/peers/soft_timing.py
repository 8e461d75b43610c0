"""How a peer is timed on a fabric or a bag: process CPU time over one play."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import closing
from typing import Protocol

import numpy as np

from ..errors import WarpDeformError
from .soft_scene import SoftScene, soft_scene
from .timing import FRAME_RATE, PeerTiming, check_measurement

__all__ = ["SoftWorld", "measure_soft", "play_frames"]

_MOST_REPEATS = 3  # a play of a 25 x 25 sheet or a bag takes a peer the better part of a minute
_CUT = {"cloth50": 0.2}  # [s]; in the peers such a play would take minutes
_WARM_UP = 3  # frames of a throw-away world


class SoftWorld(Protocol):
    """One soft scene in another engine."""

    def hold(self) -> None:
        """Take vertex 0."""

    def release(self) -> None:
        """Let it go."""

    def frame(self, target: np.ndarray | None = None) -> None:
        """Advance by 1 / FRAME_RATE simulated seconds, the held vertex to `target` (3,) [m]."""

    def vertices(self) -> np.ndarray:
        """Positions (V, 3) [m]."""

    def close(self) -> None:
        """Give back what the engine holds."""


def measure_soft(
    make_world: Callable[[SoftScene], SoftWorld],
    *,
    engine: str,
    scene: str,
    seconds: float | None,
    repeats: int,
    hz: int,
    iterations: int,
    note: str,
) -> PeerTiming:
    """Time `make_world` on starts 0 .. repeats - 1 of `scene`, at most three, after a warm-up.

    A sheet's figure is the mean over the whole play, a bag's the mean over its fall; the one at
    rest is of what follows. `seconds` cuts the play short, and then nothing is known of rest; a
    50 x 50 sheet is always cut, at 0.2 s: free fall, landing and lying flat.

    Raises:
        InputError: `seconds` is shorter than a frame or `repeats` is less than 1.
        WarpDeformError: the engine's positions became non-finite.
    """
    check_measurement(seconds, repeats)
    with closing(make_world(soft_scene(scene))) as world:
        for _ in range(_WARM_UP):
            world.frame()
    all_frames, rest_frames, stretch = [], [], 1.0
    repeats = min(repeats, _MOST_REPEATS)
    most = min(seconds or np.inf, _CUT.get(scene, np.inf))
    for seed in range(repeats):
        start = soft_scene(scene, seed=seed)
        play = start.before + start.held + start.after
        frames = round(FRAME_RATE * min(play, most))
        with closing(make_world(start)) as world:
            spent, longest = play_frames(world, start, frames)
        if not np.isfinite(longest):
            raise WarpDeformError(f"{engine} diverged on scene {scene}, start {seed}")
        stretch = max(stretch, longest)
        moving = round(FRAME_RATE * (start.before + start.held))
        figure = spent if len(start.times) else spent[:moving]
        all_frames.append(1e3 * FRAME_RATE * float(np.mean(figure)))
        if most >= play:
            rest_frames.append(1e3 * FRAME_RATE * float(np.mean(spent[moving:])))
    if most < play:
        note = f"{note}; only the first {frames / FRAME_RATE:.2g} s of the play are timed"
    return PeerTiming(
        engine=engine,
        scene=scene,
        ms_per_sim_second_p50=float(np.percentile(all_frames, 50)),
        ms_per_sim_second_p95=float(np.percentile(all_frames, 95)),
        rest_ms_per_sim_second_p50=float(np.percentile(rest_frames, 50)) if rest_frames else None,
        rest_ms_per_sim_second_p95=float(np.percentile(rest_frames, 95)) if rest_frames else None,
        hz=hz,
        iterations=iterations,
        bodies=len(start.vertices),
        stretch_max=stretch,
        seconds=frames / FRAME_RATE,
        repeats=repeats,
        note=note,
    )


def play_frames(world: SoftWorld, scene: SoftScene, frames: int) -> tuple[list[float], float]:
    """CPU seconds of each frame of the play, and the largest stretch; not finite if it diverged."""
    take = round(FRAME_RATE * scene.before)
    leave = take + round(FRAME_RATE * scene.held)
    knots = scene.knots
    spent, stretch = [], 1.0
    for k in range(frames):
        if k == take < leave:
            knots = scene.knots + world.vertices()[0]
            world.hold()
        if k == leave > take:
            world.release()
        target = None
        if take <= k < leave:
            at = (k + 1 - take) / FRAME_RATE
            target = np.array([np.interp(at, scene.times, axis) for axis in knots.T])
        before = time.process_time()
        world.frame(target)
        spent.append(time.process_time() - before)
        # a position that is not a number makes the maximum one that is not
        stretch = float(np.maximum(stretch, scene.stretch(world.vertices())))
    return spent, stretch
