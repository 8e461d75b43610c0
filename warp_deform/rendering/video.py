"""Videos and pictures on disk: written beside their place and moved there when they are whole."""

from __future__ import annotations

import os
from collections.abc import Generator
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np

from ..errors import InputError

__all__ = ["VideoWriter", "write_png"]


def _place(path: str | os.PathLike[str], extension: str) -> tuple[Path, Path]:
    """`path` and the temporary name beside it.

    Raises:
        InputError: wrong extension, or the folder is missing or cannot be written to.
    """
    path = Path(path)
    if path.suffix.lower() != extension:
        raise InputError(f"{path} must end with {extension}")
    if path.is_dir():
        raise InputError(f"{path} is a folder; give a file name that ends with {extension}")
    if not path.parent.is_dir():
        raise InputError(f"the folder {path.parent} does not exist; create it first")
    if not os.access(path.parent, os.W_OK):
        raise InputError(f"the folder {path.parent} is not writable; choose another place")
    return path, path.with_name(f".{path.stem}.{os.getpid()}.partial{extension}")


def _checked(frame: np.ndarray) -> np.ndarray:
    frame = np.ascontiguousarray(frame)
    if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:
        raise InputError(f"a frame must be (H, W, 3) uint8, got {frame.shape} {frame.dtype}")
    return frame


def write_png(path: str | os.PathLike[str], color: np.ndarray) -> None:
    """Write an RGB picture (H, W, 3) uint8 as PNG.

    Raises:
        InputError: the path does not end with .png, cannot be written, or `color` is no picture.
    """
    path, partial = _place(path, ".png")
    ok, data = cv2.imencode(".png", cv2.cvtColor(_checked(color), cv2.COLOR_RGB2BGR))
    if not ok:
        raise InputError(f"{path}: a picture of shape {color.shape} cannot be encoded")
    try:
        partial.write_bytes(data.tobytes())
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


class VideoWriter:
    """Writes an H.264 video (yuv420p, so every player shows it), one frame in memory at a time.

    path: ends with .mp4; fps: frames a second. Use it as a context manager: the file appears when
    the block ends well and holds at least a frame, and nothing is left of it otherwise.

    Raises:
        InputError: the path does not end with .mp4 or cannot be written, or fps is not positive.
    """

    def __init__(self, path: str | os.PathLike[str], fps: float) -> None:
        self._path, self._partial = _place(path, ".mp4")
        if not 0 < fps < 1000:
            raise InputError(f"fps must be between 0 and 1000, got {fps}")
        self._fps = fps
        self._size: tuple[int, int] | None = None
        self._stream: Generator[None, np.ndarray, None] | None = None
        self.frames = 0

    def __enter__(self) -> VideoWriter:
        return self

    def write(self, frame: np.ndarray) -> None:
        """Append a frame (H, W, 3) uint8; all have the first one's size.

        An odd row or column is repeated once, as the format needs even sizes.
        """
        frame = _checked(frame)
        if self._size is None:
            self._size = frame.shape[:2]
            self._stream = self._open(frame)
        if frame.shape[:2] != self._size:
            raise InputError(f"a frame is {frame.shape[:2]}, the first one was {self._size}")
        assert self._stream is not None
        self._stream.send(_even(frame))
        self.frames += 1

    def _open(self, frame: np.ndarray) -> Generator[None, np.ndarray, None]:
        import imageio_ffmpeg

        rows, columns = _even(frame).shape[:2]
        stream: Generator[None, np.ndarray, None] = imageio_ffmpeg.write_frames(
            str(self._partial),
            (columns, rows),
            fps=self._fps,
            codec="libx264",
            pix_fmt_out="yuv420p",
            macro_block_size=2,
            quality=None,
            ffmpeg_log_level="error",
            # faststart: a browser can play before it has the whole file
            output_params=["-crf", "20", "-movflags", "+faststart", "-threads", "1"],
        )
        stream.send(None)  # type: ignore[arg-type]  # starts the generator
        return stream

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        try:
            if self._stream is not None:
                self._stream.close()
                if kind is None:
                    self._partial.replace(self._path)
        finally:
            self._partial.unlink(missing_ok=True)


def _even(frame: np.ndarray) -> np.ndarray:
    rows, columns = frame.shape[:2]
    if rows % 2 == 0 and columns % 2 == 0:
        return frame
    return np.pad(frame, ((0, rows % 2), (0, columns % 2), (0, 0)), mode="edge")
