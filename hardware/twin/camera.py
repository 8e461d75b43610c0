"""A camera in software: what a camera on the hand sees of a `CableTwin`.

A pinhole without distortion looks down on foam and chain from where the hand is. The chain is drawn
as one stroke with a bright spot on every bead; light falls off towards one side; the picture is a
little blurred and noisy. There is no hand in it: at the home pose it is out of view.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import numpy as np

from warp_deform.errors import InputError
from warp_deform.rendering.strand_mask import draw_line
from warp_deform.support.flag_range import check_seed

from ..arm.panda import PandaKinematics
from ..arm.table_plane import TablePlane
from ..calibration.calibration import Calibration
from ..calibration.homography import plane_homography
from ..cameras.camera import CameraError, CameraIntrinsics, Frame
from ..support.closing import Closing
from .twin import TwinConfig, TwinLook

__all__ = ["SimCamera", "SimCameraConfig", "sim_calibration"]

Rgb = tuple[float, float, float]

_SAMPLES = 6  # a pixel and side
_BITS = 4  # of a pixel, for OpenCV's drawing
_NEAREST = 0.05  # [m]


def _mount() -> np.ndarray:
    """Return tcp_T_camera (4, 4): 7 cm ahead of the fingers, 5 cm above their tips."""
    T = np.eye(4)
    # columns along the hand's y axis, rows back towards the base
    T[:3, :3] = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    T[:3, 3] = 0.07, 0.0, -0.05
    return T


@dataclass(frozen=True, eq=False, kw_only=True)
class SimCameraConfig:
    """The camera and the light."""

    size: tuple[int, int] = (1280, 720)
    """Width and height [px]."""
    focal_px: float = 610.0
    """Focal length [px]: that of an Azure Kinect's colour camera."""
    tcp_T_camera: np.ndarray = field(default_factory=_mount)
    """Where the camera is on the hand; z looks out of it [m]."""
    foam_margin_m: float = 0.03
    """How far the foam reaches beyond the workspace [m]."""
    foam: Rgb = (62.0, 68.0, 74.0)
    """Colour of the foam, 0 to 255."""
    table: Rgb = (150.0, 132.0, 110.0)
    """Colour of the table around it."""
    chain: Rgb = (214.0, 208.0, 196.0)
    """Colour of the chain."""
    shade: float = 0.15
    """By how much the far side of the picture is darker."""
    grain: float = 3.0
    """Standard deviation of the foam's structure, in levels."""
    blur_px: float = 0.8
    """Standard deviation of the blur [px]."""
    noise: float = 2.0
    """Standard deviation of the noise, in levels."""

    def __post_init__(self) -> None:
        if np.asarray(self.tcp_T_camera).shape != (4, 4) or not self.focal_px > 0:
            raise InputError("sim camera: tcp_T_camera is (4, 4) and focal_px above 0")
        for name in ("foam_margin_m", "shade", "grain", "blur_px", "noise"):
            if not 0 <= getattr(self, name) < math.inf:
                raise InputError(f"sim camera: {name} must be 0 or more")

    @property
    def intrinsics(self) -> CameraIntrinsics:
        """Focal length and middle of the picture; no distortion."""
        width, height = self.size
        K = np.array(
            [[self.focal_px, 0, (width - 1) / 2], [0, self.focal_px, (height - 1) / 2], [0, 0, 1.0]]
        )
        return CameraIntrinsics(self.size, K, np.zeros(0))


def sim_calibration(
    twin: TwinConfig | None = None, camera: SimCameraConfig | None = None
) -> Calibration:
    """Return the exact calibration of a twin's camera at the home pose.

    Pixels are mapped to the plane of the chain's middle, one radius above the foam, as when a board
    as thick as the chain is calibrated on: at the workspace's ends half a thickness is a pixel.
    """
    twin, camera = twin or TwinConfig(), camera or SimCameraConfig()
    home_q = np.array(twin.home_q)
    base_T_camera = PandaKinematics().pose(home_q) @ camera.tcp_T_camera
    middle = TablePlane(twin.foam_height_m + twin.chain.radius)
    return Calibration(
        robot_id="sim",
        camera_id="sim",
        home_q=home_q,
        intrinsics=camera.intrinsics,
        base_H_pixel=plane_homography(camera.intrinsics, base_T_camera, middle),
        table=twin.table,
        method="hand-eye",
        error_m=0.0,
        x=twin.view.x,
        y=twin.view.y,
        details={"exact": True},
    )


class SimCamera(Closing):
    """Pictures of a twin.

    Args:
        look: tells what there is to see: `twin.look`, or
            `functools.partial(emulator.call_world, "look")`
        twin: the configuration of that twin
        config: the camera and the light
        seed: of noise and of the foam's structure
    """

    def __init__(
        self,
        look: Callable[[], TwinLook],
        *,
        twin: TwinConfig | None = None,
        config: SimCameraConfig | None = None,
        seed: int = 0,
    ) -> None:
        self._look = look
        self._twin = twin or TwinConfig()
        self.config = config or SimCameraConfig()
        self._intrinsics = self.config.intrinsics
        self._closed = False
        self.reseed(seed)

    def reseed(self, seed: int) -> None:
        """Begin noise and the foam's structure anew, as those of a camera made with that seed."""
        self._rng = np.random.default_rng(check_seed(seed))
        width, height = self.config.size
        coarse = self._rng.normal(0.0, self.config.grain, (height // 2, width // 2))
        self._grain = cv2.resize(coarse.astype(np.float32), (width, height))

    def read(self) -> Frame:
        """Return a picture of the twin as it is now.

        Raises:
            CameraError: closed, or the hand holds the camera so low that it sees nothing
        """
        if self._closed:
            raise CameraError("the camera was closed; open another")
        image = self._draw(self._look())
        on_foam = np.abs(image - np.array(self.config.foam, np.float32)).max(axis=2) < 40.0
        image += (self._grain * on_foam)[..., None]
        light = 1.0 - self.config.shade * np.linspace(1.0, 0.0, len(image), dtype=np.float32)
        image *= light[:, None, None]
        if self.config.blur_px > 0:
            image = np.asarray(cv2.GaussianBlur(image, (0, 0), self.config.blur_px))
        image += self._rng.normal(0.0, self.config.noise, image.shape).astype(np.float32)
        rgb = np.clip(np.rint(image), 0, 255).astype(np.uint8)
        return Frame(rgb, None, self._intrinsics, time.time())

    def close(self) -> None:
        """Give no more pictures."""
        self._closed = True

    def _draw(self, look: TwinLook) -> np.ndarray:
        """Return the picture without light, blur and noise, (h, w, 3) float32."""
        config, twin = self.config, self._twin
        width, height = config.size
        m, z = config.foam_margin_m, twin.foam_height_m
        (x0, x1), (y0, y1) = twin.view.x, twin.view.y
        rim = np.array([[x0 - m, y0 - m, z], [x1 + m, y0 - m, z], [x1 + m, y1 + m, z],
                        [x0 - m, y1 + m, z]])  # fmt: skip
        corners, _ = self._project(rim, look.base_T_tcp)
        image = np.empty((height, width, 3), np.float32)
        image[:] = config.table
        foam = np.rint(corners * 2**_BITS).astype(np.int32)
        cv2.fillPoly(image, [foam], config.foam, lineType=cv2.LINE_AA, shift=_BITS)
        at, depth = self._project(look.beads, look.base_T_tcp)
        widths = 2 * twin.chain.visual_radius * config.focal_px / depth
        low = np.clip(np.floor(at.min(axis=0) - widths.max()).astype(int), 0, config.size)
        high = np.clip(np.ceil(at.max(axis=0) + widths.max()).astype(int), 0, config.size)
        if (high <= low).any():
            return image  # the chain is out of view
        # Coverage is drawn large and made smaller, so that edges are where they belong.
        large = (at - low + 0.5) * _SAMPLES - 0.5
        size = (high - low) * _SAMPLES
        strand, spots = np.zeros(size[::-1], np.uint8), np.zeros(size[::-1], np.uint8)
        draw_line(strand, large, float(widths.mean()) * _SAMPLES)
        for point, wide in zip(np.rint(large * 2**_BITS).astype(int), widths, strict=True):
            radius = round(0.33 * float(wide) * _SAMPLES * 2**_BITS)
            cv2.circle(spots, point.tolist(), radius, 255, -1, cv2.LINE_8, _BITS)
        patch = image[low[1] : high[1], low[0] : high[0]]
        dark = np.multiply(config.chain, 0.8)
        for mask, color in ((strand, dark), (spots, np.array(config.chain))):
            small = cv2.resize(mask, (high - low).tolist(), interpolation=cv2.INTER_AREA)
            share = small.astype(np.float32)[..., None] / 255.0
            patch += share * (color.astype(np.float32) - patch)
        return image

    def _project(self, points: np.ndarray, base_T_tcp: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return columns, rows (n, 2) [px] and depths [m] of points (n, 3) in the base frame."""
        camera_T_base = np.linalg.inv(base_T_tcp @ self.config.tcp_T_camera)
        in_camera = points @ camera_T_base[:3, :3].T + camera_T_base[:3, 3]
        if not in_camera[:, 2].min() > _NEAREST:
            raise CameraError("the camera is too low to see the workspace; go to the home pose")
        pixels = in_camera @ self._intrinsics.matrix.T
        return pixels[:, :2] / pixels[:, 2:], in_camera[:, 2]
