"""Any camera that the system offers as a video device: OpenCV, no vendor's package.

The colour stream of an Azure Kinect or a Femto is such a device, too. A video device does not tell
its intrinsics: `warp-deform franka calibrate lens` measures them. Never tried on a device by the
authors.
"""

from __future__ import annotations

import cv2
import numpy as np

from .camera import CameraError, CameraIntrinsics
from .streaming import StreamConfig, StreamingCamera

__all__ = ["UVCCamera"]

# V4L2's values of cv2.CAP_PROP_AUTO_EXPOSURE.
_MANUAL_EXPOSURE = 1


class _VideoDevice:
    def __init__(self, index: int, size: tuple[int, int]) -> None:
        self._capture = cv2.VideoCapture(index)
        if not self._capture.isOpened():
            self._capture.release()
            raise CameraError(
                f"video device {index} cannot be opened; see whether it is plugged in, whether "
                "another program has it, and whether you may read it"
            )
        self._capture.set(cv2.CAP_PROP_FRAME_WIDTH, size[0])
        self._capture.set(cv2.CAP_PROP_FRAME_HEIGHT, size[1])
        self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)

    def grab(self) -> tuple[np.ndarray, None]:
        done, image = self._capture.read()
        if not done:
            raise CameraError("the video device gave no picture; check its cable, then try again")
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB)), None

    def freeze(self) -> None:
        """Keep exposure and white balance as they are now; not every driver can."""
        for automatic, off, value in (
            (cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL_EXPOSURE, cv2.CAP_PROP_EXPOSURE),
            (cv2.CAP_PROP_AUTO_WB, 0, cv2.CAP_PROP_WB_TEMPERATURE),
        ):
            settled = self._capture.get(value)
            if self._capture.set(automatic, off) and settled > 0:
                self._capture.set(value, settled)

    def release(self) -> None:
        self._capture.release()


class UVCCamera(StreamingCamera):
    """A video device.

    Args:
        intrinsics: calibrated; their size is the one that is asked of the device
        index: number of the video device
        config: time limits and warm-up

    Raises:
        CameraError: it cannot be opened, hangs, or has no pictures of this size
    """

    def __init__(
        self, intrinsics: CameraIntrinsics, *, index: int = 0, config: StreamConfig | None = None
    ) -> None:
        super().__init__(
            f"video device {index}",
            lambda: (_VideoDevice(index, intrinsics.size), intrinsics),
            config=config,
        )
