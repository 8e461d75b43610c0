"""RealSense cameras through pyrealsense2; depth is aligned to colour, intrinsics are the device's.

Never tried on a device by the authors; tested against a stand-in for the vendor's package.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from warp_deform.support.extras import install_extra

from .camera import CameraError, CameraIntrinsics
from .streaming import StreamConfig, StreamingCamera

__all__ = ["RealSenseCamera"]

_FRAME_TIMEOUT_MS = 1000


class _RealSense:
    def __init__(self, serial: str | None, size: tuple[int, int], fps: int) -> None:
        try:
            import pyrealsense2 as rs
        except ImportError as error:
            raise CameraError(
                f"pyrealsense2 cannot be loaded ({error}); in the clone run: "
                f"{install_extra('realsense')}, and install libusb-1.0"
            ) from error
        self._rs = rs
        config = rs.config()
        if serial is not None:
            config.enable_device(serial)
        config.enable_stream(rs.stream.color, *size, rs.format.rgb8, fps)
        config.enable_stream(rs.stream.depth, *size, rs.format.z16, fps)
        self._pipeline = rs.pipeline()
        try:
            self._profile = self._pipeline.start(config)
        except RuntimeError as error:
            raise CameraError(
                f"the RealSense does not start: {' '.join(str(error).split())}; check its cable "
                f"(USB 3) and that it offers {size[0]} x {size[1]} at {fps} Hz"
            ) from error
        self._align = rs.align(rs.stream.color)
        self._unit = self._profile.get_device().first_depth_sensor().get_depth_scale()

    def intrinsics(self) -> CameraIntrinsics:
        stream = self._profile.get_stream(self._rs.stream.color).as_video_stream_profile()
        lens: Any = stream.get_intrinsics()
        if any(lens.coeffs) and lens.model != self._rs.distortion.brown_conrady:
            # D405 and D455 tell those of the inverse model: from distorted pixels to straight ones.
            raise CameraError(
                f"the RealSense describes its lens by {lens.model}, not by OpenCV's Brown-Conrady "
                "model; use it as --camera uvc, and measure its lens first with `warp-deform "
                "franka calibrate lens --camera uvc`"
            )
        K = np.array([[lens.fx, 0.0, lens.ppx], [0.0, lens.fy, lens.ppy], [0.0, 0.0, 1.0]])
        return CameraIntrinsics((lens.width, lens.height), K, np.array(lens.coeffs, dtype=float))

    def grab(self) -> tuple[np.ndarray, np.ndarray]:
        try:
            frames = self._align.process(self._pipeline.wait_for_frames(_FRAME_TIMEOUT_MS))
        except RuntimeError as error:
            raise CameraError(
                f"the RealSense gave no picture: {' '.join(str(error).split())}; check its cable"
            ) from error
        # Copied: the buffers are the driver's and are used again.
        rgb = np.array(frames.get_color_frame().get_data(), dtype=np.uint8)
        levels = np.array(frames.get_depth_frame().get_data(), dtype=np.float32)
        return rgb, levels * np.float32(self._unit)

    def freeze(self) -> None:
        sensor, option = self._profile.get_device().first_color_sensor(), self._rs.option
        for automatic in (option.enable_auto_exposure, option.enable_auto_white_balance):
            if sensor.supports(automatic):
                sensor.set_option(automatic, 0)

    def release(self) -> None:
        self._pipeline.stop()


class RealSenseCamera(StreamingCamera):
    """A RealSense.

    Args:
        serial: which device; None for the only one
        size: width and height of colour and depth [px]
        fps: pictures a second
        config: time limits and warm-up

    Raises:
        CameraError: the package is missing, the device does not start or hangs, or its lens is
            described by a model that OpenCV does not have
    """

    def __init__(
        self,
        *,
        serial: str | None = None,
        size: tuple[int, int] = (1280, 720),
        fps: int = 30,
        config: StreamConfig | None = None,
    ) -> None:
        def open_device() -> tuple[_RealSense, CameraIntrinsics]:
            device = _RealSense(serial, size, fps)
            try:
                return device, device.intrinsics()
            except CameraError:
                device.release()
                raise

        super().__init__(f"RealSense {serial or ''}".strip(), open_device, config=config)
