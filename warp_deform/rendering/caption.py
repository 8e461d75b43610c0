"""Text and a small top-down picture on a frame."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

__all__ = ["Caption", "annotate"]


class Caption:
    """Text at the upper left of frames, a picture at their upper right.

    Args:
        rows: of a frame
        lines: one below the other, the first one larger (task, then action and score, say)
        inset: picture (h, w, 3) uint8, drawn at 45 % of the frame's height
    """

    def __init__(
        self, rows: int, *, lines: Sequence[str] = (), inset: np.ndarray | None = None
    ) -> None:
        self._rows, self._lines = rows, tuple(lines)
        self._inset = None if inset is None else _framed(inset, rows)

    def draw(self, frame: np.ndarray) -> None:
        """Draw it into `frame` (rows, W, 3) uint8."""
        rows, columns = frame.shape[:2]
        margin = max(rows // 36, 4)
        if self._inset is not None:
            height, width = self._inset.shape[:2]
            border = max(rows // 360, 1)
            top, left = margin - border, columns - margin - width + border
            # beyond the frame it is cut off
            part = self._inset[max(-top, 0) : rows - top, max(-left, 0) :]
            top, left = max(top, 0), max(left, 0)
            frame[top : top + part.shape[0], left : left + part.shape[1]] = part
        baseline = margin
        for i, line in enumerate(self._lines):
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


def _framed(inset: np.ndarray, rows: int) -> np.ndarray:
    """The picture at 45 % of `rows`, in a white frame."""
    height = round(0.45 * rows)
    width = max(round(height * inset.shape[1] / inset.shape[0]), 1)
    shrinking = height < inset.shape[0]
    border = max(rows // 360, 1)
    framed = np.full((height + 2 * border, width + 2 * border, 3), 255, np.uint8)
    framed[border:-border, border:-border] = cv2.resize(
        np.ascontiguousarray(inset),
        (width, height),
        interpolation=cv2.INTER_AREA if shrinking else cv2.INTER_LINEAR,
    )
    return framed


def annotate(
    frame: np.ndarray, *, lines: Sequence[str] = (), inset: np.ndarray | None = None
) -> np.ndarray:
    """A copy of `frame` (H, W, 3) uint8 with a `Caption`."""
    frame = frame.copy()
    Caption(len(frame), lines=lines, inset=inset).draw(frame)
    return frame
