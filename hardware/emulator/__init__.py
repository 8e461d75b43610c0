"""A Franka Panda in software: a Franka Control Interface server (version 5) on loopback.

The vendor's own client, libfranka 0.9 as panda-python brings it, connects to it as to a robot:

    with EmulatorProcess() as emulator:
        panda = panda_py.Panda(emulator.host)

or from a shell, `warp-deform franka emulate`.

It has both ports, all four motion generators and torque control, the gripper, loss of
communication, user stop and recovery, and a hook for a simulated world around the hand. It raises
the reflexes of joint range, of joints', end effector's and elbow's velocity, acceleration and jerk,
of torques and their rate, of contact, of motions that end while they move, and of 20 packets lost
in a row; through shorter gaps a motion goes on at its last acceleration. Wrong bytes, numbers and
moments are refused by the protocol's own statuses.

What a real robot does and this one does not:

- Gravity, Coriolis and static friction: they are compensated without error. The joints' inertia is
  constant and diagonal; loads and impedances are accepted and change nothing.
- Controllers that lag: a motion generator is followed exactly, so that no path deviation, power
  limit or instability is ever raised. A torque controller beside a motion generator rules alone.
- Braking: whatever ends a motion stops the arm within a millisecond, and the end of torque control
  is accepted at any speed. Fingers stop where they are when their client leaves.
- Its own inverse kinematics, which is not published: here the least joint motion. Which Cartesian
  motions ask too much of the joints near a singularity differs, and none is refused for starting
  in one. Self-collision, Cartesian walls and the safety rules of Desk are not watched.
- Collision thresholds: only the upper nominal ones count. Forces are exact and not filtered.
- Noise: states show what was commanded, not what sensors measure. Filters of SetFilters are off.
- In lock-step no packet is ever late or lost; at 1 kHz (`paced`) a late one counts as lost.

What passes here may still be too rough for a real arm.
"""

from .process import EmulatorFailed, EmulatorProcess, serve_emulator
from .world import Contact, Hand, TableWorld, World

__all__ = [
    "Contact",
    "EmulatorFailed",
    "EmulatorProcess",
    "Hand",
    "TableWorld",
    "World",
    "serve_emulator",
]
