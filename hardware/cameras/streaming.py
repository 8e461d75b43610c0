"""What live cameras share: opening, warming up and reading, each within a time limit."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np

from warp_deform.errors import InputError

from ..backends.bounded import run_bounded
from ..camera import CameraError, CameraIntrinsics, Frame
from ..closing import Closing

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
    """A `Camera` over a device that may hang.

    A device that once gave no answer in time is given up: its thread may still hold it.

    Args:
        name: for messages: "camera /dev/video0"
        open_device: opens the device; raises CameraError where it cannot
        intrinsics: of the pictures; None where the device tells them, which `open_device` then
            returns beside it

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
        self._device: Device | None = None
        self._gone = False
        timeout = self._config.open_timeout_s
        try:
            self._device, self._intrinsics = run_bounded(open_device, timeout_s=timeout)
        except TimeoutError as error:
            raise CameraError(
                f"{name} did not open in {timeout:g} s; unplug it, plug it in, close other programs"
            ) from error
        try:
            for _ in range(self._config.warm_up_frames):
                self._grab()
            self._bounded(self._device.freeze)
            self.read()
        except BaseException:
            self.close()
            raise

    def read(self) -> Frame:
        """Return a picture taken after this call; see `Camera.read`."""
        for _ in range(self._config.stale_frames):
            self._grab()
        rgb, depth = self._grab()
        return Frame(rgb, depth, self._intrinsics, time.time())

    def close(self) -> None:
        """Let the device go; see `Camera.close`."""
        device, self._device = self._device, None
        if device is not None and not self._gone:
            try:
                run_bounded(device.release, timeout_s=_CLOSE_TIMEOUT)
            except TimeoutError:
                self._gone = True

    def _grab(self) -> tuple[np.ndarray, np.ndarray | None]:
        if self._device is None:
            raise CameraError(f"{self._name} is closed; open it again")
        return self._bounded(self._device.grab)

    def _bounded(self, call: Callable[[], T]) -> T:
        if self._gone:
            raise CameraError(f"{self._name} stopped answering earlier; open it again")
        try:
            return run_bounded(call, timeout_s=self._config.read_timeout_s)
        except TimeoutError as error:
            self._gone = True
            raise CameraError(
                f"{self._name} gave no picture in {self._config.read_timeout_s:g} s; "
                "check its cable and open it again"
            ) from error
