"""`warp-deform franka emulate`: a Panda in software, for the vendor's own client."""

from __future__ import annotations

import contextlib
import sys
from dataclasses import dataclass
from typing import Annotated, Any

from tyro.conf import arg

from warp_deform.command.main import CommandOptions, Outcome
from warp_deform.errors import InputError
from warp_deform.support.flag_range import SEED, FlagRange

from ..rig.config import WorkspaceFlag

__all__ = ["EmulateOptions", "emulate"]


@dataclass(frozen=True, kw_only=True)
class EmulateOptions(CommandOptions):
    """Serve an emulated Franka Panda to the vendor's own client until Ctrl-C."""

    host: str = "127.0.0.1"
    """Address to listen on: one of this machine, 127.x.y.z."""
    chain: Annotated[int | None, arg(metavar="SEED"), SEED] = None
    """Toss a bead chain onto foam under the hand, and show it to --camera sim."""
    table_z: Annotated[float | None, arg(metavar="M"), FlagRange(-1.0, 1.0)] = None
    """Height [m] of a bare table, in place of foam and chain."""
    object_width: Annotated[float | None, arg(metavar="M"), FlagRange(0.0, 0.08)] = None
    """Width [m] of the object that every grasp finds. The default is no object."""
    workspace: WorkspaceFlag = None
    """Limits of the workspace [m] along x and y, into which the chain is tossed, as of `run`."""
    paced: bool = False
    """Run at 1 kHz by the wall clock, as a robot does. The default is as fast as possible, in
    lock-step."""


def emulate(options: EmulateOptions) -> Outcome:
    """Serve until Ctrl-C."""
    from ..emulator import TableWorld, serve_emulator
    from ..emulator.server import EmulatorConfig

    config = EmulatorConfig(host=options.host, paced=options.paced)
    if options.chain is not None and (options.table_z, options.object_width) != (None, None):
        raise InputError(
            "--chain excludes --table-z and --object-width: the chain lies on foam and is what is "
            "grasped"
        )
    with contextlib.ExitStack() as stack:
        world: Any = TableWorld(table_z=options.table_z, object_width=options.object_width or 0.0)
        if options.chain is not None:
            from ..calibration.workplace import Workplace
            from ..twin.look_server import LookServer, WatchedTwin
            from ..twin.twin import TwinConfig

            place = Workplace().with_flags(workspace=options.workspace)
            world = WatchedTwin(TwinConfig(seed=options.chain, view=place.view))
            stack.enter_context(LookServer(world.look, host=options.host))
        pace = "1 kHz" if options.paced else "in lock-step"
        print(
            f"an emulated Panda serves {options.host}, {pace}; Ctrl-C ends it",
            file=sys.stderr,
            flush=True,
        )
        with contextlib.suppress(KeyboardInterrupt):
            serve_emulator(config, world=world)
    return Outcome(data={"host": options.host, "chain": options.chain}, text="ended")
