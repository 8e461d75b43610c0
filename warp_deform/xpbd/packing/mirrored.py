"""Arrays that the host and the device see alike."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

__all__ = ["Mirrored", "aligned"]

_LINE = 64
"""Bytes of a line of the processor's cache; a lane vector that lies in two is read twice."""


def aligned(count: int, dtype: Any, *, zero: bool = False) -> tuple[Any, np.ndarray]:
    """A Warp array on the CPU that begins with a line of the cache, and its bytes.

    NumPy allocates it, which asks for large pages for what is large. Without `zero` it holds
    anything.
    """
    size = wp.types.type_size_in_bytes(dtype) * count
    memory = (np.zeros if zero else np.empty)(size + _LINE, dtype=np.uint8)
    start = -memory.ctypes.data % _LINE
    memory = memory[start : start + size]
    array = wp.array(ptr=memory.ctypes.data, dtype=dtype, shape=(count,), device="cpu")
    array._bytes = memory  # they live as long as the array
    return array, memory


class Mirrored:
    """A Warp array with a NumPy view of its scalars; on the CPU the view is the array itself."""

    def __init__(
        self, count: int, dtype: Any, device: Any, scalar: Any, shape: tuple[int, ...]
    ) -> None:
        self._host, memory = aligned(max(count, 1), dtype, zero=True)
        self.array = self._host if device.is_cpu else wp.zeros_like(self._host, device=device)
        self.view: np.ndarray = memory.view(scalar).reshape(max(count, 1), *shape)

    def like(self, count: int | None = None) -> Mirrored:
        """Another one of the same elements, all 0; None: of as many."""
        elements = len(self.view) if count is None else count
        shape, number = self.view.shape[1:], self.view.dtype.type
        return Mirrored(elements, self.array.dtype, self.array.device, number, shape)

    def to_device(self) -> None:
        """Make the device see what was written to `view`."""
        if self.array is not self._host:
            wp.copy(self.array, self._host)

    def to_host(self) -> None:
        """Make `view` see what a kernel wrote."""
        if self.array is not self._host:
            wp.copy(self._host, self.array)
