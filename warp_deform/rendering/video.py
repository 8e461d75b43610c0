"""Videos and pictures on disk: written beside their place and moved there when they are whole."""

from __future__ import annotations

import contextlib
import os
import subprocess
import tempfile
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np

from ..errors import InputError, WarpDeformError

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

    Use it as a context manager: the file appears when the block ends well, and nothing is left of
    it otherwise.

    Args:
        path: ends with .mp4
        fps: frames a second

    Raises:
        InputError: the path does not end with .mp4 or cannot be written, fps is not positive, or
            the block ends without a frame.
        WarpDeformError: ffmpeg is missing or gives up, because a disk is full, say.
    """

    def __init__(self, path: str | os.PathLike[str], fps: float) -> None:
        self._path, self._partial = _place(path, ".mp4")
        if not 0 < fps < 1000:
            raise InputError(f"fps must be between 0 and 1000, got {fps}")
        self._fps = fps
        self._size: tuple[int, int] | None = None
        self._encoder: subprocess.Popen[bytes] | None = None
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
            self._encoder = self._start(_even(frame).shape[:2])
        if frame.shape[:2] != self._size:
            raise InputError(f"a frame is {frame.shape[:2]}, the first one was {self._size}")
        assert self._encoder is not None and self._encoder.stdin is not None
        # half of ffmpeg's time for it; chroma is one pixel's of four, not their mean (53 dB apart)
        planes = cv2.cvtColor(_even(frame), cv2.COLOR_RGB2YUV_I420)
        try:
            self._encoder.stdin.write(planes)
        except BrokenPipeError as error:
            self._encoder.wait()
            raise self._failure() from error
        self.frames += 1

    def _start(self, size: tuple[int, ...]) -> subprocess.Popen[bytes]:
        import imageio_ffmpeg

        self._log = tempfile.TemporaryFile()
        # ultrafast at 25: a fifth of the CPU time of the default preset at 20, and nearer to the
        # planes it is given (54.3 and 52.8 dB over a film of cable-shape), in three times the bytes
        command = (
            f"-y -loglevel error -f rawvideo -pix_fmt yuv420p -s {size[1]}x{size[0]} "
            f"-r {self._fps} -i - -an -c:v libx264 -preset ultrafast -crf 25 -threads 1 "
            # faststart: a browser can play before it has the whole file
            "-pix_fmt yuv420p -movflags +faststart"
        )
        try:
            return subprocess.Popen(
                [imageio_ffmpeg.get_ffmpeg_exe(), *command.split(), str(self._partial.absolute())],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=self._log,
            )
        except (OSError, RuntimeError) as error:
            raise WarpDeformError(
                f"{self._path} was not written: no ffmpeg could be started "
                f"({_last_line(str(error))}); `warp-deform doctor` says which one is used"
            ) from error

    def _failure(self) -> WarpDeformError:
        """What ffmpeg said last."""
        self._log.seek(0)
        said = _last_line(self._log.read().decode(errors="replace"))
        return WarpDeformError(f"{self._path} was not written, as ffmpeg gave up: {said}")

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        encoder = self._encoder
        try:
            if kind is None:
                if encoder is None:
                    raise InputError(f"{self._path} was not written: a video needs a frame")
                # also closes the pipe, which tells ffmpeg that this is all
                encoder.communicate()
                if encoder.returncode != 0:
                    raise self._failure()
                self._partial.replace(self._path)
        finally:
            if encoder is not None and encoder.stdin is not None:
                encoder.kill()
                encoder.wait()
                # a dead encoder does not take what is still buffered
                with contextlib.suppress(BrokenPipeError):
                    encoder.stdin.close()
                self._log.close()
            self._partial.unlink(missing_ok=True)


def _last_line(text: str) -> str:
    lines = [line.strip() for line in text.splitlines()]
    reasons = [line for line in lines if line and line != "Conversion failed!"]
    return reasons[-1] if reasons else "it gave no reason"


def _even(frame: np.ndarray) -> np.ndarray:
    rows, columns = frame.shape[:2]
    if rows % 2 == 0 and columns % 2 == 0:
        return frame
    return np.pad(frame, ((0, rows % 2), (0, columns % 2), (0, 0)), mode="edge")
