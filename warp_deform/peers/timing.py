"""How a peer is timed: process CPU time per simulated second, while it falls and at rest."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ..errors import InputError, WarpDeformError
from .scene import PeerScene, peer_scene

__all__ = ["FRAME_RATE", "PeerWorld", "check_measurement", "measure"]

FRAME_RATE = 60
"""Frames per simulated second; positions are read once a frame, outside the timed part."""
REST_AFTER = 2.0
"""Simulated time after which a scene counts as at rest [s]; the original's settling time."""
_WARM_UP = 6  # frames of a throw-away world


class PeerWorld(Protocol):
    """One scene in another engine."""

    def frame(self) -> None:
        """Advance by 1 / FRAME_RATE simulated seconds."""

    def beads(self) -> np.ndarray:
        """Bead centres, or the block's origin, (bodies, 3) [m]."""

    def close(self) -> None:
        """Give back what the engine holds."""


@dataclass(frozen=True, kw_only=True)
class PeerTiming:
    """What one engine costs on one scene. Times are process CPU milliseconds per simulated second.

    The figures without `rest` are of the time from the fall's start, and of a sheet's whole play;
    those with it begin when two simulated seconds have passed, or when a sheet lies folded and a
    bag has lain down. p50 and p95 are over the repeats, each from another start.
    """

    engine: str
    scene: str
    ms_per_sim_second_p50: float
    ms_per_sim_second_p95: float
    rest_ms_per_sim_second_p50: float | None
    """None where the play was cut before anything came to rest."""
    rest_ms_per_sim_second_p95: float | None
    hz: int
    """Solver steps per simulated second."""
    iterations: int
    """Solver iterations per step."""
    bodies: int
    stretch_max: float
    """Longest link over its rest length, over all frames and repeats; 1 without links."""
    seconds: float
    """Simulated time of one measurement [s]."""
    repeats: int
    note: str
    """What this engine leaves out, in words."""

    def report(self) -> dict[str, float | int | str]:
        """The keys of a benchmark report that concern a peer; those without a value are absent."""
        values: dict[str, float | int | str | None] = {
            "peer": self.engine,
            "peer_ms_per_sim_second": self.ms_per_sim_second_p50,
            "peer_ms_per_sim_second_p95": self.ms_per_sim_second_p95,
            "peer_rest_ms_per_sim_second": self.rest_ms_per_sim_second_p50,
            "peer_rest_ms_per_sim_second_p95": self.rest_ms_per_sim_second_p95,
            "peer_hz": self.hz,
            "peer_iterations": self.iterations,
            "peer_stretch": self.stretch_max,
            "peer_seconds": self.seconds,
            "peer_repeats": self.repeats,
            "peer_note": self.note,
        }
        return {key: value for key, value in values.items() if value is not None}


def check_measurement(seconds: float | None, repeats: int) -> None:
    """Refuse what is no measurement; `seconds` is None where a scene has its own.

    Raises:
        InputError: `seconds` is shorter than a frame or `repeats` is less than 1.
    """
    if seconds is not None and not seconds * FRAME_RATE >= 1:
        raise InputError(f"seconds must be at least one frame, 1/{FRAME_RATE} s, got {seconds}")
    if repeats < 1:
        raise InputError(f"repeats must be at least 1, got {repeats}")


def measure(
    make_world: Callable[[PeerScene], PeerWorld],
    *,
    engine: str,
    scene: str,
    seconds: float,
    repeats: int,
    hz: int,
    iterations: int,
    note: str,
) -> PeerTiming:
    """Time `make_world` on starts 0 .. repeats - 1 of `scene`, after a throw-away warm-up.

    Raises:
        InputError: `seconds` is shorter than a frame or `repeats` is less than 1.
        WarpDeformError: the engine's positions became non-finite.
    """
    check_measurement(seconds, repeats)
    frames = round(seconds * FRAME_RATE)
    with closing(make_world(peer_scene(scene))) as world:
        _run(world, _WARM_UP)
    falling, resting, stretch = [], [], 1.0
    for seed in range(repeats):
        start = peer_scene(scene, seed=seed)
        with closing(make_world(start)) as world:
            fall, seen = _run(world, frames)
            _, between = _run(world, max(0, round(REST_AFTER * FRAME_RATE) - frames))
            rest, still = _run(world, frames)
        falling.append(fall)
        resting.append(rest)
        for positions in (*seen, *between, *still):
            if not np.isfinite(positions).all():
                raise WarpDeformError(f"{engine} diverged on scene {scene}, start {seed}")
            stretch = max(stretch, start.stretch(positions))
    return PeerTiming(
        engine=engine,
        scene=scene,
        ms_per_sim_second_p50=float(np.percentile(falling, 50)),
        ms_per_sim_second_p95=float(np.percentile(falling, 95)),
        rest_ms_per_sim_second_p50=float(np.percentile(resting, 50)),
        rest_ms_per_sim_second_p95=float(np.percentile(resting, 95)),
        hz=hz,
        iterations=iterations,
        bodies=start.bodies,
        stretch_max=stretch,
        seconds=frames / FRAME_RATE,
        repeats=repeats,
        note=note,
    )


def _run(world: PeerWorld, frames: int) -> tuple[float, list[np.ndarray]]:
    """CPU milliseconds per simulated second over `frames`, and the positions after each."""
    spent, seen = 0.0, []
    for _ in range(frames):
        before = time.process_time()
        world.frame()
        spent += time.process_time() - before
        seen.append(world.beads())
    return 1e3 * spent * FRAME_RATE / max(1, frames), seen
