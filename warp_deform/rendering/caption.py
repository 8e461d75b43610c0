"""Text and a small top-down picture on a frame."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

__all__ = ["annotate"]


def annotate(
    frame: np.ndarray, *, lines: Sequence[str] = (), inset: np.ndarray | None = None
) -> np.ndarray:
    """A copy of `frame` (H, W, 3) uint8 with text at the upper left, a picture at the upper right.

    lines: one below the other, the first one larger (task, then action and score, say)
    inset: (h, w, 3) uint8, drawn at 45 % of the frame's height
    """
    frame = frame.copy()
    rows, columns = frame.shape[:2]
    margin = max(rows // 36, 4)
    if inset is not None:
        height = round(0.45 * rows)
        width = max(round(height * inset.shape[1] / inset.shape[0]), 1)
        shrinking = height < inset.shape[0]
        small = cv2.resize(
            np.ascontiguousarray(inset),
            (width, height),
            interpolation=cv2.INTER_AREA if shrinking else cv2.INTER_LINEAR,
        )
        top, left = margin, columns - margin - width
        border = max(rows // 360, 1)
        cv2.rectangle(
            frame,
            (left - border, top - border),
            (left + width + border - 1, top + height + border - 1),
            (255, 255, 255),
            -1,
        )
        frame[top : top + height, left : left + width] = small
    baseline = margin
    for i, line in enumerate(lines):
        scale = rows / 720 * (1.0 if i == 0 else 0.75)
        (_, height), _ = cv2.getTextSize(line, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)
        baseline += round(1.25 * height)
        cv2.putText(
            frame,
            line,
            (margin, baseline),
            cv2.FONT_HERSHEY_SIMPLEX,
            scale,
            (45, 47, 50),
            max(round(1.6 * scale), 1),
            cv2.LINE_AA,
        )
        baseline += round(0.5 * height)
    return frame
