"""Synthetic episodes for the tests of the dataset format."""

from __future__ import annotations

import dataclasses

import numpy as np

from warp_deform.episodes import (
    Episode,
    EpisodeInfo,
    Goal,
    Step,
    combine_hashes,
    cpu_fingerprint,
    state_hash,
    versions,
)

# Actions inside the workspace [m, rad].
LOW = np.array([0.3, -0.4, -3.0, 0.3, -0.4, -3.0, 0.04])
HIGH = np.array([0.7, 0.4, 3.0, 0.7, 0.4, 3.0, 0.40])


def make_episode(
    seed: int = 0,
    *,
    actions: int = 2,
    size: tuple[int, int] = (16, 12),
    goal: bool = False,
    particles: int = 5,
) -> Episode:
    """A random episode whose every field is filled, with images of `size` (H, W)."""
    rng = np.random.default_rng(seed)

    def floats(*shape: int) -> np.ndarray:
        return rng.standard_normal(shape).astype(np.float32)

    steps = tuple(
        Step(
            color=make_color(rng, size),
            height=make_height(rng, size),
            action=None if t == actions else rng.uniform(LOW, HIGH),
            score=float(rng.random()),
            success=t == actions,
            physics_ok=True,
            sim_seconds=1.5 * t,
            state_hash=state_hash(floats(3)),
            outcome=None if t == actions else ("placed", "missed", "unreachable")[t % 3],
            particle_q=floats(particles, 3),
            particle_qd=floats(particles, 3),
            body_q=floats(2, 7),
            body_qd=floats(2, 6),
            ground_truth=floats(9),
        )
        for t in range(actions + 1)
    )
    info = EpisodeInfo(
        task="cable-shape-notarget" if goal else "cable-ring",
        seed=seed,
        success=True,
        score=0.1 + 0.2,
        actions=actions,
        demonstrator="scripted",
        robot="ur5",
        state_hash=combine_hashes(step.state_hash for step in steps),
        physics_ok=True,
        sim_seconds=1.5 * actions,
        discarded_starts=seed % 2,
        config={"beads": 32, "speed": 0.15, "nested": {"names": ["a", "é"], "none": None}},
        versions=versions(),
        cpu=cpu_fingerprint(),
        goal=None,
        extra={"note": "synthetic"},
    )
    made = Goal(
        color=make_color(rng, size),
        height=make_height(rng, size),
        targets=rng.standard_normal((4, 3)),
        kind="constructed",
        seed=100_000 + seed,
    )
    return Episode(info=info, steps=steps, goal=made if goal else None)


def make_color(rng: np.random.Generator, size: tuple[int, int]) -> np.ndarray:
    """A smooth scene with a disc of a random colour, (H, W, 3) uint8."""
    y, x = np.mgrid[0 : size[0], 0 : size[1]]
    centre = rng.random(2) * size
    image = np.repeat((40 + 100 * y[..., None] / size[0]).astype(np.uint8), 3, axis=2)
    image[np.hypot(y - centre[0], x - centre[1]) < min(size) / 4] = rng.integers(0, 256, 3)
    return image


def make_height(rng: np.random.Generator, size: tuple[int, int]) -> np.ndarray:
    """A bumpy height map [m], (H, W) float32."""
    y, x = np.mgrid[0 : size[0], 0 : size[1]]
    bump = 0.05 * (1 + np.sin(x / 5 + rng.random()) * np.cos(y / 7))
    return (bump + 0.001 * rng.random(size)).astype(np.float32)


def with_info(episode: Episode, **changes: object) -> Episode:
    """The episode with some of its metadata replaced."""
    return dataclasses.replace(episode, info=dataclasses.replace(episode.info, **changes))


def with_step(episode: Episode, t: int, **changes: object) -> Episode:
    """The episode with some of row t replaced."""
    steps = list(episode.steps)
    steps[t] = dataclasses.replace(steps[t], **changes)
    return dataclasses.replace(episode, steps=tuple(steps))


def assert_same_record(found: object, expected: object, *, tolerance: float) -> None:
    """Compare two Steps or Goals: bit by bit, but heights [m] to `tolerance`."""
    assert type(found) is type(expected)
    for field in dataclasses.fields(found):  # type: ignore[arg-type]
        a, b = getattr(found, field.name), getattr(expected, field.name)
        assert type(a) is type(b), field.name
        if not isinstance(a, np.ndarray):
            assert a == b, field.name
            continue
        assert (a.dtype, a.shape) == (b.dtype, b.shape), field.name
        if field.name == "height":
            assert np.abs(a.astype(float) - b).max() <= tolerance
        else:
            assert a.tobytes() == b.tobytes(), field.name


def assert_same_episode(found: Episode, expected: Episode, *, tolerance: float) -> None:
    """Compare two episodes: bit by bit, but heights [m] to `tolerance`."""
    assert dataclasses.replace(found.info, goal=None) == dataclasses.replace(
        expected.info, goal=None
    )
    assert len(found.steps) == len(expected.steps)
    for a, b in zip(found.steps, expected.steps, strict=True):
        assert_same_record(a, b, tolerance=tolerance)
    assert (found.goal is None) == (expected.goal is None)
    if found.goal is not None:
        assert_same_record(found.goal, expected.goal, tolerance=tolerance)
