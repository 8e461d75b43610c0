"""Videos and pictures on disk."""

from __future__ import annotations

import numpy as np
import pytest

from warp_deform.errors import InputError, WarpDeformError
from warp_deform.rendering.caption import annotate
from warp_deform.rendering.video import VideoWriter, write_png


@pytest.mark.parametrize("size", [(48, 64), (49, 63)])
def test_video_can_be_read_back(tmp_path, size):
    import imageio_ffmpeg

    path = tmp_path / "episode.mp4"
    with VideoWriter(path, 10) as video:
        for i in range(7):
            video.write(np.full((*size, 3), 30 * i, np.uint8))
    assert video.frames == 7
    reader = imageio_ffmpeg.read_frames(str(path))
    meta = next(reader)
    frames = [np.frombuffer(frame, np.uint8).mean() for frame in reader]
    assert meta["fps"] == 10 and meta["codec"] == "h264"
    assert meta["size"] == (size[1] + size[1] % 2, size[0] + size[0] % 2)
    np.testing.assert_allclose(frames, 30 * np.arange(7), atol=4)
    assert list(tmp_path.iterdir()) == [path]


def test_a_failed_video_leaves_nothing_and_keeps_the_old_one(tmp_path):
    path = tmp_path / "episode.mp4"
    path.write_bytes(b"old")
    with pytest.raises(RuntimeError, match="boom"), VideoWriter(path, 10) as video:
        video.write(np.zeros((16, 16, 3), np.uint8))
        raise RuntimeError("boom")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_bad_paths_and_frames_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"must end with \.mp4"):
        VideoWriter(tmp_path / "a.gif", 10)
    with pytest.raises(InputError, match="does not exist"):
        VideoWriter(tmp_path / "no" / "a.mp4", 10)
    with pytest.raises(InputError, match="fps"):
        VideoWriter(tmp_path / "a.mp4", 0)
    with pytest.raises(InputError, match="uint8"), VideoWriter(tmp_path / "a.mp4", 10) as video:
        video.write(np.zeros((16, 16, 3)))
    with (
        pytest.raises(InputError, match="the first one was"),
        VideoWriter(tmp_path / "a.mp4", 10) as video,
    ):
        video.write(np.zeros((16, 16, 3), np.uint8))
        video.write(np.zeros((16, 18, 3), np.uint8))
    with pytest.raises(InputError, match=r"must end with \.png"):
        write_png(tmp_path / "a.jpg", np.zeros((4, 4, 3), np.uint8))
    assert list(tmp_path.iterdir()) == []


def test_png_and_caption(tmp_path):
    import cv2

    frame = np.full((90, 160, 3), 200, np.uint8)
    inset = np.zeros((320, 160, 3), np.uint8)
    inset[..., 0] = 255
    drawn = annotate(frame, lines=["cable-ring", "action 1"], inset=inset)
    assert (frame == 200).all()
    assert (drawn[:, 130:] == [255, 0, 0]).all(-1).sum() > 500
    assert (drawn[:45, :60] < 120).any()
    write_png(tmp_path / "a.png", drawn)
    assert (cv2.imread(str(tmp_path / "a.png"))[..., ::-1] == drawn).all()


@pytest.mark.parametrize(
    ("script", "said"),
    [
        ("echo 'Error opening output files: Encoder not found' >&2; exit 8", "Encoder not found"),
        ("head -c 9 >/dev/null; echo 'out: No space left on device' >&2; exit 228", "No space"),
        ("cat >/dev/null; echo 'No space left on device\nConversion failed!' >&2; exit 1", "space"),
        ("exit 3", "no reason"),
    ],
)
def test_an_encoder_that_gives_up_is_one_line_and_leaves_nothing(
    tmp_path, monkeypatch, script, said
):
    encoder = tmp_path / "ffmpeg"
    encoder.write_text(f"#!/bin/sh\n{script}\n")
    encoder.chmod(0o755)
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(encoder))
    with (
        pytest.raises(WarpDeformError, match="ffmpeg gave up") as raised,
        VideoWriter(tmp_path / "a.mp4", 10) as video,
    ):
        for _ in range(50):  # more than the pipe holds
            video.write(np.zeros((120, 160, 3), np.uint8))
    assert said in str(raised.value) and "\n" not in str(raised.value)
    assert [path.name for path in tmp_path.iterdir()] == ["ffmpeg"]


def test_a_missing_encoder_is_named(tmp_path, monkeypatch):
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(tmp_path / "none"))
    with (
        pytest.raises(WarpDeformError, match="no ffmpeg could be started"),
        VideoWriter(tmp_path / "a.mp4", 10) as video,
    ):
        video.write(np.zeros((16, 16, 3), np.uint8))
    assert not list(tmp_path.iterdir())


def test_a_video_without_frames_is_refused(tmp_path):
    with pytest.raises(InputError, match="needs a frame"), VideoWriter(tmp_path / "a.mp4", 10):
        pass
    assert not list(tmp_path.iterdir())


def test_an_interrupted_video_leaves_nothing(tmp_path):
    with pytest.raises(KeyboardInterrupt), VideoWriter(tmp_path / "a.mp4", 10) as video:
        video.write(np.zeros((16, 16, 3), np.uint8))
        raise KeyboardInterrupt
    assert not list(tmp_path.iterdir())
