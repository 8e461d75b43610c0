"""A robot arm over the table: its poses, its reach, its tip-down inverse kinematics, its meshes."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from functools import cached_property
from importlib.resources import files
from typing import TYPE_CHECKING

import numpy as np

from warp_deform.errors import InputError
from warp_deform.robots.description import ArmConfig
from warp_deform.robots.kinematics import IKResult, SerialArm
from warp_deform.robots.unwrap import unwrap

if TYPE_CHECKING:
    import trimesh

__all__: list[str] = []  # `warp_deform.robots` is the import path of what is here

# A posture within reach is exact but for round-off and, near a limit of the last joint, the elbow.
TOP_DOWN_ITERATIONS = 25
INVERSE_ITERATIONS = 40
# Postures that `inverse` starts from, one after the other, for what the earlier ones missed.
ATTEMPTS = 12
WRIST_TO_TIP = 0.2  # [m], about the same on both arms
HOVER_RESOLUTION = 1e-3  # [m]
# Beyond this a number is no length in metres or angle in radians, and its square may overflow.
LARGEST_INPUT = 1e6


class Robot:
    """A serial arm whose tip points down at the table; get one from `warp_deform.robots.robot`.

    Frames: the base is the table's frame, x forward over the table, z up, table top at z = 0. The
    tip's z axis points out of the tool, so it is (0, 0, -1) when the tip points down. Arrays are
    float64; the answer for a pose has the same bits whatever else is in the batch.
    """

    def __init__(self, config: ArmConfig) -> None:
        self._config = config
        self.name = config.name
        self.dof = len(config.home_q)
        self.home_q = np.array(config.home_q)
        self.home_q.setflags(write=False)
        heights, smallest, largest = np.array(config.reach_table).T
        self._reach_table = heights, smallest, largest
        self._hover_z = np.arange(0.0, heights[-1], HOVER_RESOLUTION)
        self._hover_min = np.interp(self._hover_z, heights, smallest)
        self._hover_max = np.interp(self._hover_z, heights, largest)

    def __repr__(self) -> str:
        return f"Robot({self.name!r})"

    @cached_property
    def _arm(self) -> SerialArm:
        """The pytorch-kinematics chain; torch is imported here, not with the module."""
        config = self._config
        return SerialArm(
            _asset(config.urdf),
            root=config.root,
            flange=config.flange,
            tip_offset=config.tip_offset,
            mount_yaw=config.mount_yaw,
        )

    @property
    def urdf(self) -> bytes:
        """The arm's description as its maker publishes it, without the mount and the tip."""
        return _asset(self._config.urdf)

    @property
    def flange(self) -> str:
        """The link of the description that carries the tip."""
        return self._config.flange

    @property
    def q_min(self) -> np.ndarray:
        """Lower joint limits [rad], shape (dof,)."""
        return self._arm.low.copy()

    @property
    def q_max(self) -> np.ndarray:
        """Upper joint limits [rad], shape (dof,)."""
        return self._arm.high.copy()

    def forward(self, q: np.ndarray) -> np.ndarray:
        """Return base_T_tip, shape (N, 4, 4), of joint positions [rad] (N, dof) or (dof,).

        Raises:
            InputError: wrong shape, or a value that is not finite
        """
        return self._arm.forward(_batch(q, (self.dof,), "q"))

    def link_poses(self, q: np.ndarray) -> dict[str, np.ndarray]:
        """Return base_T_link, shape (N, 4, 4), of every link by its URDF name, and of "tip".

        Raises:
            InputError: wrong shape, or a value that is not finite
        """
        return self._arm.link_poses(_batch(q, (self.dof,), "q"))

    def top_down(self, xyz_yaw: np.ndarray) -> np.ndarray:
        """Return base_T_tip, shape (N, 4, 4), of a tip that points down at x, y, z with yaw.

        The tip's x axis is (cos yaw, sin yaw, 0). xyz_yaw is (N, 4) or (4,) [m, rad].

        Raises:
            InputError: wrong shape, or a value that is not finite
        """
        x, y, z, yaw = _batch(xyz_yaw, (4,), "xyz_yaw").T
        pose = np.zeros((len(x), 4, 4))
        cosine, sine = np.cos(yaw), np.sin(yaw)
        pose[:, 0, 0], pose[:, 0, 1], pose[:, 0, 3] = cosine, sine, x
        pose[:, 1, 0], pose[:, 1, 1], pose[:, 1, 3] = sine, -cosine, y
        pose[:, 2, 2], pose[:, 2, 3], pose[:, 3, 3] = -1.0, z, 1.0
        return pose

    def inverse(self, base_T_tip: np.ndarray, *, seed: np.ndarray | None = None) -> IKResult:
        """Return joint positions that bring the tip to poses of any orientation.

        Damped least squares from `seed` (N, dof) or (dof,); without one, from the tip-down posture
        at the same place, then for what is left from a few other postures in a fixed order. A pose
        out of reach has `reached` False.

        Raises:
            InputError: wrong shape, a value that is not finite, or a matrix that is no pose
        """
        target = _batch(base_T_tip, (4, 4), "base_T_tip")
        if not len(target):
            return self._nothing()
        turns = target[:, :3, :3]
        drift = np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3))
        if drift.max() > 1e-6 or np.linalg.det(turns).min() < 0.0:
            raise InputError("base_T_tip: the 3x3 part is no rotation; orthonormalise it first")
        if seed is not None:
            start = self._seeds(seed, len(target))
            return self._arm.solve(target, start, iterations=INVERSE_ITERATIONS)
        result = self._arm.solve(target, self._start(target, 0), iterations=INVERSE_ITERATIONS)
        for attempt in range(1, ATTEMPTS):
            rows = np.flatnonzero(~result.reached)
            if not len(rows):
                break
            start = self._start(target[rows], attempt)
            again = self._arm.solve(target[rows], start, iterations=INVERSE_ITERATIONS)
            for mine, new in zip(_arrays(result), _arrays(again), strict=True):
                mine[rows[again.reached]] = new[again.reached]
        return result

    def solve_top_down(self, xyz_yaw: np.ndarray, *, seed: np.ndarray | None = None) -> IKResult:
        """Return joint positions for tip-down poses (N, 4) [m, rad] on the arm's one branch.

        Elbow up, wrist outwards; the turn of the last joint nearest `seed` (N, dof) or (dof,), by
        default the home posture. A pose out of reach has `reached` False.

        Raises:
            InputError: wrong shape, or a value that is not finite
        """
        waypoints = _batch(xyz_yaw, (4,), "xyz_yaw")
        return self._follow(waypoints, np.arange(len(waypoints)), seed)

    def trajectory(
        self,
        waypoints: np.ndarray,
        *,
        seed: np.ndarray | None = None,
        lengths: Sequence[int] | None = None,
    ) -> IKResult:
        """Return joint waypoints for tip-down waypoints (N, 4) [m, rad] in order.

        All of them lie on one branch, so the elbow never flips, and the last joint unwraps along
        the path instead of jumping by a turn, as far as its limits allow. `seed` (dof,) is where
        the path sets out from, by default home: it chooses the turn of the last joint.

        Several paths are solved in one batch when `lengths` gives the number of waypoints of each;
        `seed` may then be (paths, dof).

        Raises:
            InputError: wrong shape, a value that is not finite, or lengths that do not add up
        """
        waypoints = _batch(waypoints, (4,), "waypoints")
        counts = np.array([len(waypoints)] if lengths is None else lengths, dtype=np.int64)
        if not len(waypoints) and not counts.any():
            return self._nothing()
        if counts.ndim != 1 or counts.sum() != len(waypoints) or counts.min() < 1:
            raise InputError(
                f"lengths: positive numbers that add up to {len(waypoints)}, not {counts.tolist()}"
            )
        return self._follow(waypoints, np.cumsum(counts) - counts, seed)

    @property
    def reach_by_height(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Heights (n,) [m] of the tip, and the smallest and largest radius in reach there."""
        return self._reach_table

    def reach(self, z: float) -> tuple[float, float]:
        """Return the smallest and largest radius [m] from the base axis of a tip-down tip at z [m].

        Every yaw is reachable between them, in all directions within 70 degrees of the x axis.
        (inf, 0.0), an empty range, at heights where the tip reaches nothing.

        Raises:
            InputError: z is not finite
        """
        if not math.isfinite(z):
            raise InputError(f"z: a finite height in metres, not {z}")
        heights, smallest, largest = self._reach_table
        if not heights[0] <= z <= heights[-1]:
            return math.inf, 0.0
        return float(np.interp(z, heights, smallest)), float(np.interp(z, heights, largest))

    def hover_height(self, x: float, y: float, wanted: float = 0.30) -> float:
        """Return `wanted`, or the greatest height [m] below it that is in reach at x, y [m].

        To 1 mm. 0.0 where no height is in reach: `solve_top_down` then reports `reached` False.

        Raises:
            InputError: a value that is not finite
        """
        if not (math.isfinite(x) and math.isfinite(y) and 0.0 <= wanted < math.inf):
            raise InputError(
                f"x, y, wanted: finite numbers, wanted not below 0, not {x}, {y}, {wanted}"
            )
        radius = math.hypot(x, y)
        smallest, largest = self.reach(wanted)
        if smallest <= radius <= largest:
            return float(wanted)
        inside = (self._hover_min <= radius) & (radius <= self._hover_max)
        inside &= self._hover_z <= wanted
        return float(self._hover_z[inside].max(initial=0.0))

    def meshes(self) -> list[tuple[str, np.ndarray, trimesh.Trimesh]]:
        """Return (link, link_T_mesh, mesh) for everything that is drawn; do not change the meshes.

        The collision meshes of the description, with the suction tip or the hand's fingers.
        """
        return list(self._meshes)

    @cached_property
    def _meshes(self) -> tuple[tuple[str, np.ndarray, trimesh.Trimesh], ...]:
        """What `meshes` returns; trimesh is imported here, not with the module."""
        import trimesh

        drawn = []
        for part in self._config.meshes:
            mesh = trimesh.load_mesh(io.BytesIO(_asset(part.file)), file_type="stl")
            pose = trimesh.transformations.rotation_matrix(part.yaw, (0.0, 0.0, 1.0))
            pose[:3, 3] = part.xyz
            drawn.append((part.link, pose, mesh))
        for cylinder in self._config.cylinders:
            mesh = trimesh.creation.cylinder(
                radius=cylinder.radius, height=cylinder.end - cylinder.start, sections=24
            )
            pose = np.eye(4)
            pose[2, 3] = 0.5 * (cylinder.start + cylinder.end)
            drawn.append((cylinder.link, pose, mesh))
        return tuple(drawn)

    def _follow(
        self, waypoints: np.ndarray, starts: np.ndarray, seed: np.ndarray | None
    ) -> IKResult:
        """Solve paths of tip-down waypoints that set out at the rows `starts`."""
        if not len(waypoints):
            return self._nothing()
        reference = self._seeds(self.home_q if seed is None else seed, len(starts))[:, -1]
        start = self._posture(waypoints, starts, reference)
        return self._arm.solve(self.top_down(waypoints), start, iterations=TOP_DOWN_ITERATIONS)

    def _nothing(self) -> IKResult:
        """Return the answer to no poses."""
        return IKResult(np.zeros((0, self.dof)), np.zeros(0, bool), np.zeros(0), np.zeros(0))

    def _posture(
        self, waypoints: np.ndarray, starts: np.ndarray, reference: np.ndarray
    ) -> np.ndarray:
        """Return the closed-form postures of paths, the last joint unwrapped from `reference`."""
        posture = self._config.posture(waypoints)
        low, high = self._arm.low[-1], self._arm.high[-1]
        posture[:, -1] = unwrap(posture[:, -1], starts, reference, low, high)
        return posture

    def _start(self, base_T_tip: np.ndarray, attempt: int) -> np.ndarray:
        """Return the postures (N, dof) from which attempt number `attempt` sets out."""
        position, outwards = base_T_tip[:, :3, 3], base_T_tip[:, :3, 2]
        if attempt == 0:
            # The tip-down posture that has the wrist where the pose has it.
            place = position - WRIST_TO_TIP * (outwards - np.array([0.0, 0.0, -1.0]))
            yaw = np.arctan2(base_T_tip[:, 1, 0], base_T_tip[:, 0, 0])
            reference = np.full(len(place), self.home_q[-1])
            return self._posture(np.column_stack([place, yaw]), np.arange(len(place)), reference)
        start = np.tile(self.home_q, (len(position), 1))
        if attempt > 1:
            # Additive recurrence: spreads evenly over the joints' ranges, the same on every call.
            spread = np.modf(attempt * np.sqrt([2.0, 3.0, 5.0, 7.0, 11.0, 13.0, 17.0]))[0]
            low, high = np.maximum(self._arm.low, -np.pi), np.minimum(self._arm.high, np.pi)
            start[:] = low + spread[: self.dof] * (high - low)
        start[:, 0] = self.home_q[0] + np.arctan2(position[:, 1], position[:, 0])
        return start

    def _seeds(self, seed: np.ndarray, count: int) -> np.ndarray:
        """Return one seed for each of `count` problems, shape (count, dof)."""
        seeds = _batch(seed, (self.dof,), "seed")
        if len(seeds) not in (1, count):
            raise InputError(f"seed: one posture, or one for each of {count}, not {len(seeds)}")
        return np.broadcast_to(seeds, (count, self.dof)) if len(seeds) == 1 else seeds


def _batch(value: np.ndarray, shape: tuple[int, ...], name: str) -> np.ndarray:
    """Return `value` as finite float64 of shape (N, *shape); a lone item becomes a batch of one."""
    try:
        array = np.array(value, dtype=np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: an array of numbers is needed ({error})") from error
    if array.shape == shape:
        array = array[None]
    if array.ndim != 1 + len(shape) or array.shape[1:] != shape:
        expected = ", ".join(("N", *map(str, shape)))
        raise InputError(f"{name}: shape ({expected}) is needed, not {array.shape}")
    sound = np.abs(array) <= LARGEST_INPUT  # False for NaN
    if not sound.all():
        row = np.argwhere(~sound)[0, 0]
        raise InputError(f"{name}: finite metres or radians are needed; row {row} is {array[row]}")
    return array


def _arrays(result: IKResult) -> tuple[np.ndarray, ...]:
    """Return the arrays of a result."""
    return result.q, result.reached, result.position_error, result.rotation_error


def _asset(path: str) -> bytes:
    """Return the contents of a file under assets/."""
    return files("warp_deform.robots").joinpath("assets", path).read_bytes()
