"""Synthetic cables: smooth curves of known tangent, and their masks and pictures."""

from __future__ import annotations

import cv2
import numpy as np

SAMPLES = 8  # a pixel and side


def curve(rng: np.random.Generator, *, length: float = 200.0) -> tuple[np.ndarray, np.ndarray]:
    """A curve about the middle of a (320, 160) picture: column, row (n, 2), and tangents (n,)."""
    n = 4000
    s = np.linspace(0.0, 1.0, n)
    bend = sum(rng.normal() * np.sin(2 * np.pi * (f * s + rng.random())) for f in (0.5, 1.0, 1.5))
    angles = rng.uniform(-np.pi, np.pi) + 4.4 * np.cumsum(bend) / n
    points = np.cumsum(np.stack([np.cos(angles), np.sin(angles)], axis=1), axis=0) * length / n
    return points - points.mean(axis=0) + [80, 160] + rng.uniform(-0.5, 0.5, 2), angles


def lone(points: np.ndarray, width: float) -> bool:
    """Whether a curve stays in the picture and does not come near itself."""
    sparse = points[::20]
    distances = np.linalg.norm(sparse[:, None] - sparse[None], axis=2)
    apart = np.abs(np.subtract.outer(np.arange(len(sparse)), np.arange(len(sparse)))) > 12
    inside = points.min() > 15 and points[:, 0].max() < 145 and points[:, 1].max() < 305
    return bool(inside and distances[apart].min() > width + 2.0)


def coverage(curves: list[np.ndarray], width: float, shape: tuple[int, int]) -> np.ndarray:
    """How much of each pixel curves of `width` [px] cover, (H, W) in [0, 1]."""
    big = np.zeros((shape[0] * SAMPLES, shape[1] * SAMPLES), np.uint8)
    for points in curves:
        fine = np.round(((points + 0.5) * SAMPLES - 0.5) * 16).astype(np.int32)
        cv2.polylines(big, [fine.reshape(-1, 1, 2)], False, 1, round(width * SAMPLES), shift=4)
    return cv2.resize(big.astype(np.float32), shape[::-1], interpolation=cv2.INTER_AREA)


def draw(curves: list[np.ndarray], width: float, shape: tuple[int, int] = (320, 160)) -> np.ndarray:
    """The curves' mask."""
    return coverage(curves, width, shape) >= 0.5
