"""A Franka Panda in software: a Franka Control Interface server (version 5) on loopback.

The vendor's own client, libfranka 0.9 as panda-python brings it, connects to it as to a robot:

    with EmulatorProcess() as emulator:
        panda = panda_py.Panda(emulator.host)

or from a shell, `python -m hardware.emulator`.

It has both ports, all four motion generators and torque control, the gripper, joint, velocity,
torque and collision limits with their reflexes, loss of communication, user stop and recovery, and
a hook for a simulated world around the hand. It has no gravity, Coriolis or static friction (that
is, they are compensated without error), its joints have constant inertia, it stops at once when a
limit is violated, and the motion generators' jerk limits are not checked. What passes here may
still be too rough for a real arm.
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
