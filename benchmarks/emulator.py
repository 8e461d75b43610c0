"""The emulated Panda: simulated seconds in a second, by the vendor's own client.

In lock-step: a joint motion there and back before a table, and a pick and place of the twin's
chain. The peer, in the same run: the joint motion at a robot's own pace (1.0 where nothing holds it
up).

    python benchmarks/emulator.py [--repeats 3] [--json]

Needs a C compiler and `panda-python` (the extra `panda`).
"""

from __future__ import annotations

import functools
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from statistics import median

import numpy as np
import tyro

from hardware.arm.limits import SafetyLimits
from hardware.arm.panda import HOME_Q
from hardware.arm.pick_place import PickPlaceAction, execute
from hardware.arm.safe_robot import SafeRobot
from hardware.backends.franka_config import NetworkedConfig
from hardware.backends.panda import PandaRobot
from hardware.emulator import EmulatorProcess
from hardware.emulator.server import EmulatorConfig
from hardware.twin.twin import CableTwin, TwinConfig
from warp_deform.tasks.chain_shapes import straight_chain

SPEED = 0.2  # of the joints' greatest
HOME = np.array(HOME_Q)
AWAY = HOME + np.array([0.4, 0.1, -0.1, 0.1, 0.1, -0.1, 0.2])
TWIN = TwinConfig()
ACTION = PickPlaceAction((0.45, 0.0), np.pi / 2, (0.55, 0.05), np.pi / 2)


@dataclass(frozen=True)
class Options:
    """What to measure."""

    repeats: int = 3  # the median of so many
    json: bool = False  # one JSON object on stdout


def main(options: Options) -> None:
    """Measure and print."""
    peer = rate(EmulatorProcess(EmulatorConfig(paced=True), free_host=True), arm, options.repeats)
    rows = {
        "arm": rate(EmulatorProcess(free_host=True), arm, options.repeats),
        "arm and chain": rate(
            EmulatorProcess(world=functools.partial(CableTwin, TWIN), free_host=True),
            chain,
            options.repeats,
        ),
    }
    if options.json:
        print(json.dumps({"paced": peer, "lock_step": rows}))
        return
    print(f"{'':15}{'simulated s in a second':>25}{'ratio to a robot':>18}")
    print(f"{'paced':15}{peer:25.2f}{1.0:18.1f}")
    for name, value in rows.items():
        print(f"{name:15}{value:25.2f}{value / peer:18.1f}")


def arm(emulator: EmulatorProcess, robot: PandaRobot) -> None:
    """Move from home and back."""
    for q in (AWAY, HOME):
        robot.move_joints(q, speed=SPEED)


def chain(emulator: EmulatorProcess, robot: PandaRobot) -> None:
    """Carry the middle of a straight chain 11 cm."""
    beads = straight_chain(TWIN.chain, np.array(ACTION.pick_xy), ACTION.pick_yaw)
    foam = np.array([0.0, 0.0, TWIN.foam_height_m])
    emulator.call_world("lay", beads=beads + foam)
    limits = replace(SafetyLimits(table=TWIN.table), max_joint_speed=SPEED)
    execute(SafeRobot(robot, limits), ACTION)


def rate(
    process: EmulatorProcess,
    motion: Callable[[EmulatorProcess, PandaRobot], None],
    repeats: int,
) -> float:
    """Return simulated seconds per second of a motion, the median."""
    rates = []
    with process as emulator, PandaRobot(NetworkedConfig(host=emulator.host)) as robot:
        robot.move_joints(HOME, speed=SPEED)
        for _ in range(repeats):
            before, clock = emulator.snapshot()["sim_seconds"], time.perf_counter()
            motion(emulator, robot)
            passed = emulator.snapshot()["sim_seconds"] - before
            rates.append(passed / (time.perf_counter() - clock))
    return median(rates)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
