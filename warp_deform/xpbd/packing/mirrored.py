"""Arrays that the host and the device see alike."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
import warp as wp

__all__ = ["Mirrored"]


class Mirrored:
    """A Warp array with a NumPy view of its scalars; on the CPU the view is the array itself."""

    def __init__(
        self, count: int, dtype: Any, device: Any, scalar: Any, shape: tuple[int, ...]
    ) -> None:
        self._host = wp.zeros(max(count, 1), dtype=dtype, device="cpu")
        self.array = self._host if device.is_cpu else wp.zeros_like(self._host, device=device)
        shape = (max(count, 1), *shape)
        size = int(np.prod(shape)) * np.dtype(scalar).itemsize
        buffer = (ctypes.c_byte * size).from_address(self._host.ptr)
        self.view: np.ndarray = np.frombuffer(buffer, dtype=scalar).reshape(shape)

    def to_device(self) -> None:
        """Make the device see what was written to `view`."""
        if self.array is not self._host:
            wp.copy(self.array, self._host)

    def to_host(self) -> None:
        """Make `view` see what a kernel wrote."""
        if self.array is not self._host:
            wp.copy(self._host, self.array)
