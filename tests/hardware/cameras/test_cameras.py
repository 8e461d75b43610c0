"""Cameras: frames, replay, time limits, and the vendors' packages missing or stood in for."""

from __future__ import annotations

import re
import subprocess
import sys
import threading
import time
import types
from pathlib import Path

import cv2
import numpy as np
import pytest
from fixtures.places import ROOT

from hardware.cameras.azure_kinect import AzureKinectCamera
from hardware.cameras.camera import CameraError, CameraIntrinsics, FileCamera, Frame, read_image
from hardware.cameras.realsense import RealSenseCamera
from hardware.cameras.streaming import StreamConfig, StreamingCamera
from hardware.cameras.uvc import UVCCamera
from warp_deform.errors import InputError

SIZE = (64, 48)
INTRINSICS = CameraIntrinsics(
    SIZE, np.array([[60.0, 0, 31.5], [0, 60, 23.5], [0, 0, 1]]), np.array([-0.2, 0.05, 1e-3, 0, 0])
)
QUICK = StreamConfig(open_timeout_s=0.3, read_timeout_s=0.2, warm_up_frames=3, stale_frames=1)


class FakeDevice:
    """Pictures whose grey level counts them; hangs or fails when told."""

    def __init__(self, *, hang_at: int | None = None, shape: tuple = (48, 64, 3)) -> None:
        self.count, self.hang_at, self.shape = 0, hang_at, shape
        self.frozen_at: int | None = None
        self.released = 0
        self.let_go = threading.Event()

    def grab(self) -> tuple[np.ndarray, None]:
        self.count += 1
        if self.count == self.hang_at:
            self.let_go.wait(10.0)
        return np.full(self.shape, self.count, np.uint8), None

    def freeze(self) -> None:
        self.frozen_at = self.count

    def release(self) -> None:
        self.released += 1


def test_warm_up_freezes_and_stale_pictures_are_dropped() -> None:
    device = FakeDevice()
    with StreamingCamera("fake", lambda: (device, INTRINSICS), config=QUICK) as camera:
        assert device.frozen_at == 3
        before = device.count
        frame = camera.read()
        assert frame.rgb[0, 0, 0] == before + 2
        assert abs(frame.timestamp_s - time.time()) < 5.0 and frame.depth_m is None
    assert device.released == 1
    camera.close()
    assert device.released == 1
    with pytest.raises(CameraError, match="closed"):
        camera.read()


@pytest.mark.parametrize("hang_at", [2, 9])
def test_a_camera_that_hangs_is_given_up_in_time(hang_at: int) -> None:
    device = FakeDevice(hang_at=hang_at)
    clock = time.monotonic()
    try:
        with pytest.raises(CameraError, match=r"fake gave no picture in 0.2 s; check its cable"):
            camera = StreamingCamera("fake", lambda: (device, INTRINSICS), config=QUICK)
            for _ in range(5):
                camera.read()
        assert time.monotonic() - clock < 20.0
        if hang_at == 9:
            camera.close()
        assert device.released == 0, "its thread may still hold the device"
    finally:
        device.let_go.set()
    until = time.monotonic() + 5.0
    while not device.released and time.monotonic() < until:
        time.sleep(0.005)
    assert device.released == 1, "and lets it go when it comes back"


class Unplugged(FakeDevice):
    """Gives no picture from a reading on, as after its cable was pulled out."""

    def grab(self) -> tuple[np.ndarray, None]:
        if self.count >= 8:
            raise CameraError("the fake gave no picture; check its cable, then try again")
        return super().grab()

    def release(self) -> None:
        super().release()
        raise RuntimeError("no such device")


@pytest.mark.parametrize("broken", [FakeDevice(hang_at=8), Unplugged()], ids=["hangs", "unplugged"])
def test_a_camera_that_failed_is_opened_anew_by_the_next_reading(broken: FakeDevice) -> None:
    working = FakeDevice()
    there: list[FakeDevice | None] = [broken, None, working]
    opened: list[FakeDevice] = []

    def open_device() -> tuple[FakeDevice, CameraIntrinsics]:
        device = there[len(opened)] if len(opened) < 2 else working
        if device is None:
            there[1] = working
            raise CameraError("no device; plug it in")
        opened.append(device)
        return device, INTRINSICS

    try:
        with StreamingCamera("fake", open_device, config=QUICK) as camera:
            camera.read()
            for wrong in ("gave no picture", "plug it in"):
                with pytest.raises(CameraError, match=wrong):
                    camera.read()
            assert camera.read().rgb[0, 0, 0] == 5, "warmed up, frozen, and a picture in between"
            assert opened == [broken, working] and working.frozen_at == 3
            camera.read()
    finally:
        broken.let_go.set()
    assert working.released == 1
    with pytest.raises(CameraError, match="closed"):
        camera.read()


def test_another_camera_in_its_place_is_refused() -> None:
    other = CameraIntrinsics(SIZE, np.diag([70.0, 70, 1]), np.zeros(5))
    devices = [(Unplugged(), INTRINSICS), (FakeDevice(), other), (FakeDevice(), INTRINSICS)]
    waiting = iter(devices)
    with StreamingCamera("fake", lambda: next(waiting), config=QUICK) as camera:
        camera.read()
        for wrong in ("gave no picture", "other intrinsics"):
            with pytest.raises(CameraError, match=wrong):
                camera.read()
        np.testing.assert_array_equal(camera.read().intrinsics.matrix, INTRINSICS.matrix)
    assert [device.released for device, _ in devices] == [1, 1, 1]


def test_a_camera_that_does_not_open() -> None:
    wait = threading.Event()

    def never() -> tuple[FakeDevice, CameraIntrinsics]:
        wait.wait(10.0)
        return FakeDevice(), INTRINSICS

    with pytest.raises(CameraError, match=r"did not open in 0.3 s"):
        StreamingCamera("fake", never, config=QUICK)
    wait.set()


def test_a_picture_of_another_size_is_refused_and_the_device_let_go() -> None:
    device = FakeDevice(shape=(24, 32, 3))
    with pytest.raises(CameraError, match="intrinsics are for 64 x 48"):
        StreamingCamera("fake", lambda: (device, INTRINSICS), config=QUICK)
    assert device.released == 1


@pytest.mark.parametrize("change", [{"read_timeout_s": 0.0}, {"warm_up_frames": -1}])
def test_a_wrong_stream_configuration(change: dict) -> None:
    with pytest.raises(InputError, match="camera"):
        StreamConfig(**change)


def test_no_video_device() -> None:
    with pytest.raises(CameraError, match="video device 77 cannot be opened"):
        UVCCamera(INTRINSICS, index=77)


@pytest.mark.parametrize(
    ("module", "kind", "advice"),
    [
        ("pyrealsense2", RealSenseCamera, r"\.\[realsense\]"),
        ("pyk4a", AzureKinectCamera, "UVCCamera"),
    ],
)
def test_a_vendors_package_that_is_missing(
    monkeypatch: pytest.MonkeyPatch, module: str, kind: type, advice: str
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(CameraError, match=f"{module} cannot be loaded.*{advice}"):
        kind()


def test_azure_kinect_against_a_stand_in(monkeypatch: pytest.MonkeyPatch) -> None:
    log: list[str] = []

    class Calibration:
        def get_camera_matrix(self, _: object) -> np.ndarray:
            return np.array([[600.0, 0, 640], [0, 600, 360], [0, 0, 1]])

        def get_distortion_coefficients(self, _: object) -> np.ndarray:
            return np.zeros(8)

    class PyK4A:
        calibration = Calibration()
        exposure, whitebalance = 8000, 4500

        def __init__(self, *, config: object, device_id: int) -> None:
            log.append(f"device {device_id}")

        def start(self) -> None:
            log.append("start")

        def stop(self) -> None:
            log.append("stop")

        def get_capture(self, timeout: int) -> types.SimpleNamespace:
            bgra = np.zeros((720, 1280, 4), np.uint8)
            bgra[..., 2] = 200  # red
            depth = np.full((720, 1280), 500, np.uint16)
            return types.SimpleNamespace(color=bgra, transformed_depth=depth)

    names = {"ColorResolution": "RES_720P", "DepthMode": "NFOV_UNBINNED", "FPS": "FPS_30",
             "CalibrationType": "COLOR"}  # fmt: skip
    fake = types.SimpleNamespace(
        PyK4A=PyK4A,
        Config=lambda **_: None,
        K4AException=RuntimeError,
        **{name: types.SimpleNamespace(**{member: 1}) for name, member in names.items()},
    )
    monkeypatch.setitem(sys.modules, "pyk4a", fake)
    with AzureKinectCamera(config=QUICK) as camera:
        frame = camera.read()
    assert frame.rgb[0, 0].tolist() == [200, 0, 0]
    assert frame.depth_m is not None and frame.depth_m[0, 0] == np.float32(0.5)
    assert log == ["device 0", "start", "stop"]


def test_file_camera_replays_in_order(tmp_path: Path) -> None:
    for number in (2, 10, 1):
        picture = np.full((48, 64, 3), (0, 0, number), np.uint8)  # BGR: red counts
        cv2.imwrite(str(tmp_path / f"{number:03d}_rgb.png"), picture)
    cv2.imwrite(str(tmp_path / "010_depth.png"), np.full((48, 64), 5000, np.uint16))
    with FileCamera(tmp_path, INTRINSICS) as camera:
        frames = [camera.read() for _ in range(len(camera))]
        with pytest.raises(CameraError, match="ended after 3 frames"):
            camera.read()
    assert [frame.rgb[0, 0, 0] for frame in frames] == [1, 2, 10]
    assert frames[0].depth_m is None
    np.testing.assert_allclose(frames[2].depth_m, 0.5)


def test_file_camera_without_files(tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / "none"):
        with pytest.raises(InputError):
            FileCamera(folder, INTRINSICS)


@pytest.mark.parametrize("data", [b"", b"GIF89a" + bytes(40), b"\x89PNG\r\n\x1a\n" + b"\xff" * 40])
def test_a_damaged_picture(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "000_rgb.png"
    path.write_bytes(data)
    with pytest.raises(InputError, match="picture"):
        read_image(path, color=True)


def test_depth_of_another_size_is_refused() -> None:
    with pytest.raises(CameraError, match="align"):
        Frame(np.zeros((48, 64, 3), np.uint8), np.zeros((4, 4), np.float32), INTRINSICS, 0.0)


def test_distortion_and_its_inverse() -> None:
    pixels = np.random.default_rng(0).uniform([0, 0], SIZE, (50, 2))
    again = INTRINSICS.distort(INTRINSICS.undistort(pixels))
    np.testing.assert_allclose(again, pixels, atol=1e-6)
    centre = INTRINSICS.matrix[:2, 2][None]
    np.testing.assert_allclose(INTRINSICS.distort(centre), centre, atol=1e-9)


@pytest.mark.parametrize(
    ("matrix", "distortion"),
    [
        (np.eye(2), np.zeros(5)),
        (np.diag([0.0, 1, 1]), np.zeros(5)),
        (np.diag([1.0, 1, 2]), np.zeros(5)),
        (np.eye(3), np.zeros(3)),
        (np.eye(3), np.full(5, np.nan)),
    ],
)
def test_wrong_intrinsics(matrix: np.ndarray, distortion: np.ndarray) -> None:
    with pytest.raises(InputError, match="intrinsics"):
        CameraIntrinsics(SIZE, matrix, distortion)


def test_nothing_opens_a_window_and_importing_loads_no_vendor() -> None:
    modules = sorted(
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for path in (ROOT / "hardware").rglob("*.py")
        if path.name not in {"__init__.py", "__main__.py"}
    )
    for path in (ROOT / "hardware").rglob("*.py"):
        assert not re.search(r"cv2.imshow|namedWindow|waitKey", path.read_text())
    vendors = "{'panda_py', 'franky', 'frankapy', 'pyk4a', 'pyrealsense2', 'rospy', 'autolab_core'}"
    simulator = "{'torch', 'warp', 'newton'}"
    script = (
        "import os, sys, hardware\n"
        f"print(sorted(({vendors} | {simulator}) & set(sys.modules)))\n"
        + "".join(f"import {name}\n" for name in modules)
        + f"print(sorted({vendors} & set(sys.modules)), flush=True)\n"
        "os._exit(0)"  # to take a simulator's modules apart costs more than a second
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, cwd=ROOT, check=True
    )
    assert done.stdout == "[]\n[]\n"


def make_realsense(model: str, coeffs: list[float], log: list[str]) -> types.SimpleNamespace:
    """A stand-in for pyrealsense2 with one device."""
    found = types.SimpleNamespace(
        width=1280, height=720, fx=640.0, fy=640.0, ppx=640.0, ppy=360.0, model=model, coeffs=coeffs
    )
    stream = types.SimpleNamespace(get_intrinsics=lambda: found)
    color = types.SimpleNamespace(get_data=lambda: np.full((720, 1280, 3), 7, np.uint8))
    depth = types.SimpleNamespace(get_data=lambda: np.full((720, 1280), 500, np.uint16))
    frames = types.SimpleNamespace(get_color_frame=lambda: color, get_depth_frame=lambda: depth)
    sensor = types.SimpleNamespace(supports=lambda option: False, get_depth_scale=lambda: 1e-3)
    device = types.SimpleNamespace(
        first_depth_sensor=lambda: sensor, first_color_sensor=lambda: sensor
    )
    profile = types.SimpleNamespace(
        get_device=lambda: device,
        get_stream=lambda kind: types.SimpleNamespace(as_video_stream_profile=lambda: stream),
    )
    pipeline = types.SimpleNamespace(
        start=lambda config: profile,
        stop=lambda: log.append("stop"),
        wait_for_frames=lambda limit: frames,
    )
    return types.SimpleNamespace(
        config=lambda: types.SimpleNamespace(enable_stream=lambda *_: None),
        pipeline=lambda: pipeline,
        align=lambda kind: types.SimpleNamespace(process=lambda frames: frames),
        stream=types.SimpleNamespace(color=0, depth=1),
        format=types.SimpleNamespace(rgb8=0, z16=1),
        option=types.SimpleNamespace(enable_auto_exposure=0, enable_auto_white_balance=1),
        distortion=types.SimpleNamespace(brown_conrady="distortion.brown_conrady"),
    )


@pytest.mark.parametrize(
    ("model", "coeffs", "taken"),
    [
        ("distortion.brown_conrady", [0.1, -0.2, 0.001, 0.0, 0.0], True),
        ("distortion.inverse_brown_conrady", [0.0] * 5, True),  # a D435
        ("distortion.inverse_brown_conrady", [-0.055, 0.066, -0.001, 0.001, -0.021], False),
        ("distortion.kannala_brandt4", [0.1, 0.0, 0.0, 0.0, 0.0], False),
    ],
)
def test_a_realsense_whose_lens_opencv_cannot_describe_is_refused(
    monkeypatch: pytest.MonkeyPatch, model: str, coeffs: list[float], taken: bool
) -> None:
    log: list[str] = []
    monkeypatch.setitem(sys.modules, "pyrealsense2", make_realsense(model, coeffs, log))
    if taken:
        with RealSenseCamera(config=QUICK) as camera:
            frame = camera.read()
        assert frame.depth_m is not None and frame.depth_m[0, 0] == np.float32(0.5)
        np.testing.assert_array_equal(frame.intrinsics.distortion, coeffs)
    else:
        with pytest.raises(CameraError, match=rf"{model}.*--camera uvc.*calibrate lens"):
            RealSenseCamera(config=QUICK)
    assert log == ["stop"]
