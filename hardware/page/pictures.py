"""What the operator's page draws: pictures as bytes, and a plan in pixels and heights."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from ..calibration.calibration import Calibration
from ..episodes.operators import Proposal

__all__ = ["encoded", "mask_picture", "plan_head"]

_JPEG_QUALITY = 80
_CABLE, _FOAM = 255, 40


def encoded(picture: np.ndarray, *, photograph: bool = False) -> np.ndarray:
    """A picture (H, W, 3) or (H, W) uint8 as the bytes of a PNG; photographs as those of a JPEG."""
    kind, settings = ".png", [cv2.IMWRITE_PNG_COMPRESSION, 3]
    if photograph:
        kind, settings = ".jpg", [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    done, data = cv2.imencode(kind, picture[..., ::-1] if picture.ndim == 3 else picture, settings)
    if not done:
        raise RuntimeError(f"OpenCV cannot encode a picture of shape {picture.shape}")
    return np.asarray(data, np.uint8).ravel()


def mask_picture(mask: np.ndarray) -> np.ndarray:
    """A mask (H, W) bool as a picture in grey (H, W) uint8."""
    return np.where(mask, _CABLE, _FOAM).astype(np.uint8)


def plan_head(proposal: Proposal, calibration: Calibration) -> dict[str, Any]:
    """Where a plan leads, as JSON: by waypoint its name, height above the table and pixel.

    The pixel is that of the table below the waypoint in the camera's picture, column and row; along
    is the distance on the table from the first waypoint [m].
    """
    if not proposal.poses:
        return {"way": []}
    points = np.array([pose[:3, 3] for pose in proposal.poses.values()])
    heights = points[:, 2] - calibration.table.z(points[:, :2])
    pixels = calibration.base_to_pixel(points[:, :2])
    along = np.cumsum(
        np.linalg.norm(np.diff(points[:, :2], axis=0, prepend=points[:1, :2]), axis=1)
    )
    way = [
        {"name": name, "height": float(h), "along": float(a), "pixel": [float(x) for x in pixel]}
        for name, h, a, pixel in zip(proposal.poses, heights, along, pixels, strict=True)
    ]
    return {"way": way}
