"""Episodes for the tests without simulation: a camera over a drawn cable, and choosers."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from hardware.arm.limits import SafetyLimits
from hardware.arm.panda import HOME_Q, PandaKinematics
from hardware.arm.pick_place import PickPlaceAction
from hardware.arm.safe_robot import SafeRobot
from hardware.backends.dry_run import DryRunConfig, DryRunRobot
from hardware.calibration.calibration import Calibration
from hardware.cameras.camera import Frame
from hardware.episodes.episode import EpisodeConfig, Observation, run_episode
from hardware.recordings.recorder import EpisodeRecorder, RecorderConfig
from hardware.twin.camera import SimCamera, SimCameraConfig, sim_calibration
from hardware.twin.twin import TwinConfig, TwinLook
from warp_deform.tasks.cable_mask_goal import CableMaskGoal
from warp_deform.tasks.chain_shapes import straight_chain

TWIN = TwinConfig()
TASK = CableMaskGoal()
# A small camera: the pictures of an episode are then quick to make and to write.
SMALL = SimCameraConfig(size=(640, 360), focal_px=305.0)
CALIBRATION: Calibration = sim_calibration(TWIN, SMALL)
LIMITS = SafetyLimits(table=TWIN.table, max_joint_speed=0.2)
ACTION = PickPlaceAction((0.45, 0.0), np.pi / 2, (0.55, 0.05), np.pi / 2)


def chain(x: float) -> np.ndarray:
    """Beads (90, 3) [m] of a straight chain along y at `x`, on the foam."""
    beads = straight_chain(TWIN.chain, np.array([x, 0.0]), np.pi / 2)
    return np.add(beads, (0.0, 0.0, TWIN.foam_height_m))


GOAL = TASK.mask(chain(0.50))


def drawn_camera(where: Callable[[], float]) -> SimCamera:
    """A camera over a chain that lies wherever `where` says, and an arm at home."""
    base_T_tcp = PandaKinematics().pose(np.array(HOME_Q))
    return SimCamera(
        lambda: TwinLook(chain(where()), base_T_tcp, 0.08, ()), twin=TWIN, config=SMALL
    )


class Listed:
    """A chooser that goes through a list, and keeps what it saw."""

    name = "listed"

    def __init__(self, actions: Sequence[PickPlaceAction | None]) -> None:
        self.actions, self.seen = list(actions), list[Observation]()

    def reset(self) -> None:
        self.seen = []

    def choose(self, seen: Observation) -> PickPlaceAction | None:
        self.seen.append(seen)
        return self.actions.pop(0) if self.actions else None


def recorder(folder: Path, *, goal: np.ndarray | None = GOAL) -> EpisodeRecorder:
    """A recorder whose folder `replay` can read, too."""
    config = {"episode": EpisodeConfig().to_record()}
    described = RecorderConfig(
        robot_id="test",
        camera_id="test",
        actor="listed",
        calibration=CALIBRATION.digest(),
        config=config,
    )
    made = EpisodeRecorder(folder, described, goal_mask=goal)
    CALIBRATION.save(folder / "calibration.json")
    return made


def main() -> None:
    """Run an endless episode on a dry-run robot, and say so after every action."""
    robot = SafeRobot(DryRunRobot(DryRunConfig(object_width_m=0.005)), LIMITS)
    with recorder(Path(sys.argv[1])) as made, drawn_camera(lambda: 0.45) as camera:
        run_episode(
            robot,
            camera,
            CALIBRATION,
            Listed([ACTION] * 900),
            recorder=made,
            goal=GOAL,
            config=EpisodeConfig(max_actions=900),
            say=lambda line: print(line, flush=True),
        )


def frame_of(rgb: np.ndarray) -> Frame:
    """A picture as the small camera's."""
    return Frame(rgb, None, CALIBRATION.intrinsics, time.time())


if __name__ == "__main__":
    main()
