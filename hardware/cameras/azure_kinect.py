"""The Azure Kinect, and cameras with its programming interface, through pyk4a.

The wheels of `pyk4a-bundle` need numpy 1, panda-python needs numpy 2: they do not share an
environment. Where colour is enough, which it is for a mask, use `UVCCamera` instead. Never tried on
a device by the authors; tested against a stand-in for the vendor's package.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from .camera import CameraError, CameraIntrinsics
from .streaming import StreamConfig, StreamingCamera

__all__ = ["AzureKinectCamera"]

_MILLIMETRE = np.float32(1e-3)
_FRAME_TIMEOUT_MS = 1000


class _AzureKinect:
    def __init__(self, device_id: int) -> None:
        try:
            import pyk4a
        except ImportError as error:
            raise CameraError(
                f"pyk4a cannot be loaded ({error}); in an environment of its own: "
                "pip install pyk4a-bundle 'numpy<2', or use UVCCamera for colour alone"
            ) from error
        self._k4a = pyk4a
        settings = pyk4a.Config(
            color_resolution=pyk4a.ColorResolution.RES_720P,
            depth_mode=pyk4a.DepthMode.NFOV_UNBINNED,
            camera_fps=pyk4a.FPS.FPS_30,
            synchronized_images_only=True,
        )
        self._device: Any = pyk4a.PyK4A(config=settings, device_id=device_id)
        try:
            self._device.start()
        except pyk4a.K4AException as error:
            raise CameraError(
                f"Azure Kinect {device_id} does not start ({error}); check power and USB 3, and "
                "close other programs"
            ) from error

    def intrinsics(self) -> CameraIntrinsics:
        color = self._k4a.CalibrationType.COLOR
        calibration = self._device.calibration
        return CameraIntrinsics(
            (1280, 720),
            np.array(calibration.get_camera_matrix(color), dtype=float),
            np.array(calibration.get_distortion_coefficients(color), dtype=float).ravel(),
        )

    def grab(self) -> tuple[np.ndarray, np.ndarray]:
        try:
            capture = self._device.get_capture(timeout=_FRAME_TIMEOUT_MS)
        except self._k4a.K4AException as error:
            raise CameraError(
                f"the Azure Kinect gave no picture ({error}); check its cable"
            ) from error
        rgb = np.asarray(cv2.cvtColor(capture.color, cv2.COLOR_BGRA2RGB))
        return rgb, capture.transformed_depth.astype(np.float32) * _MILLIMETRE

    def freeze(self) -> None:
        # Writing the present value switches each from automatic to manual.
        self._device.exposure = self._device.exposure
        self._device.whitebalance = self._device.whitebalance

    def release(self) -> None:
        self._device.stop()


class AzureKinectCamera(StreamingCamera):
    """An Azure Kinect at 1280 x 720.

    Args:
        device_id: which device
        config: time limits and warm-up

    Raises:
        CameraError: the package is missing, or the device does not start or hangs
    """

    def __init__(self, *, device_id: int = 0, config: StreamConfig | None = None) -> None:
        def open_device() -> tuple[_AzureKinect, CameraIntrinsics]:
            device = _AzureKinect(device_id)
            return device, device.intrinsics()

        super().__init__(f"Azure Kinect {device_id}", open_device, config=config)
