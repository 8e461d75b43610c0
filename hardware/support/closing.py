"""What is closed at the end of a `with` block: robots, cameras, recordings, the emulator."""

from __future__ import annotations

from types import TracebackType
from typing import Protocol, Self

__all__ = ["Closing"]


class Closing(Protocol):
    """Enters a `with` block as itself and closes itself at its end."""

    def close(self) -> None:
        """Give back what is held; may be called twice."""
        ...

    def _end_by(self, error: BaseException) -> None:
        """What comes before closing where an error ends the block; nothing unless overridden."""
        return None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        try:
            if value is not None:
                self._end_by(value)
        finally:
            self.close()
