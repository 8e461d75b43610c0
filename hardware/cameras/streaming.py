"""What live cameras share: opening, warming up and reading, each within a time limit."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np

from warp_deform.errors import InputError

from ..support.bounded import run_bounded
from ..support.closing import Closing
from .camera import CameraError, CameraIntrinsics, Frame

__all__ = ["Device", "StreamConfig", "StreamingCamera"]

T = TypeVar("T")
_CLOSE_TIMEOUT = 3.0  # [s]


@dataclass(frozen=True, kw_only=True)
class StreamConfig:
    """Time limits and warm-up."""

    open_timeout_s: float = 10.0
    """Longest wait for the device to open [s]."""
    read_timeout_s: float = 2.0
    """Longest wait for a picture [s]."""
    warm_up_frames: int = 30
    """Pictures thrown away first, while exposure and white balance settle; then they freeze."""
    stale_frames: int = 2
    """Pictures thrown away at each reading: those that waited in the driver's buffer."""

    def __post_init__(self) -> None:
        if not (0.0 < self.open_timeout_s <= 120.0 and 0.0 < self.read_timeout_s <= 60.0):
            raise InputError("camera timeouts: above 0 s, at most 120 s to open and 60 s to read")
        if not (0 <= self.warm_up_frames <= 1000 and 0 <= self.stale_frames <= 100):
            raise InputError("camera: at most 1000 warm-up frames and 100 stale frames, none < 0")


class Device(Protocol):
    """A vendor's camera, opened."""

    def grab(self) -> tuple[np.ndarray, np.ndarray | None]:
        """Return the next picture, (H, W, 3) uint8 RGB, and depth [m] or None; blocks."""
        ...

    def freeze(self) -> None:
        """Stop adapting exposure and white balance, so that one threshold fits all pictures."""
        ...

    def release(self) -> None:
        """Let the device go."""
        ...


class StreamingCamera(Closing):
    """A `Camera` over a device that may hang or be unplugged.

    A device that failed is let go, one that hangs as soon as it comes back; the next reading opens
    it anew.

    Args:
        name: for messages: "camera /dev/video0"
        open_device: opens the device, at first and after a failure; returns it and the intrinsics
            of its pictures; raises CameraError where it cannot

    Raises:
        CameraError: it did not open or gave no picture
    """

    def __init__(
        self,
        name: str,
        open_device: Callable[[], tuple[Device, CameraIntrinsics]],
        *,
        config: StreamConfig | None = None,
    ) -> None:
        self._name = name
        self._config = config or StreamConfig()
        self._open_device = open_device
        self._device: Device | None = None
        self._intrinsics: CameraIntrinsics | None = None
        self._closed = False
        try:
            self.read()
        except BaseException:
            self.close()
            raise

    def read(self) -> Frame:
        """Return a picture taken after this call; see `Camera.read`."""
        if self._closed:
            raise CameraError(f"{self._name} is closed; open it again")
        if self._device is None:
            self._open()
        for _ in range(self._config.stale_frames):
            self._grab()
        rgb, depth = self._grab()
        assert self._intrinsics is not None
        return Frame(rgb, depth, self._intrinsics, time.time())

    def close(self) -> None:
        """Let the device go; see `Camera.close`."""
        self._closed = True
        self._let_go()

    def _open(self) -> None:
        timeout = self._config.open_timeout_s
        try:
            self._device, intrinsics = run_bounded(self._open_device, timeout_s=timeout)
        except TimeoutError as error:
            raise CameraError(
                f"{self._name} did not open in {timeout:g} s; unplug it, plug it in, close other "
                "programs"
            ) from error
        before, self._intrinsics = self._intrinsics or intrinsics, intrinsics
        if before.to_record() != intrinsics.to_record():
            self._intrinsics = before
            self._let_go()
            raise CameraError(
                f"{self._name} came back with other intrinsics; plug in the camera that was there, "
                "or start again and calibrate"
            )
        for _ in range(self._config.warm_up_frames):
            self._grab()
        self._bounded(lambda device: device.freeze())

    def _grab(self) -> tuple[np.ndarray, np.ndarray | None]:
        return self._bounded(lambda device: device.grab())

    def _bounded(self, call: Callable[[Device], T]) -> T:
        """Return `call(device)`; a device that fails or hangs is ours no more."""
        device = self._device
        assert device is not None
        deciding = threading.Lock()
        ended = abandoned = False

        def made() -> T:
            nonlocal ended
            try:
                return call(device)
            finally:
                with deciding:
                    ended = True
                if abandoned:
                    device.release()

        try:
            return run_bounded(made, timeout_s=self._config.read_timeout_s)
        except TimeoutError as error:
            with deciding:
                abandoned = not ended
            if abandoned:
                self._device = None  # its thread holds it, and lets it go
            else:
                self._let_go()
            raise CameraError(
                f"{self._name} gave no picture in {self._config.read_timeout_s:g} s; "
                "check its cable, then try again: it is opened anew"
            ) from error
        except CameraError:
            self._let_go()
            raise

    def _let_go(self) -> None:
        device, self._device = self._device, None
        if device is None:
            return
        try:
            run_bounded(device.release, timeout_s=_CLOSE_TIMEOUT)
        except Exception as error:  # whatever a vendor raises for a device that was pulled out
            logging.getLogger(__name__).warning("letting %s go: %s", self._name, error)
