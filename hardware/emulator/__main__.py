"""Serve an emulated Franka Panda on loopback until Ctrl-C."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import NoReturn

from warp_deform.errors import InputError, WarpDeformError

from .process import serve_emulator
from .server import EmulatorConfig
from .world import TableWorld, World


class _Parser(argparse.ArgumentParser):
    """Answers a mistake in one line."""

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message}; --help lists the flags")


def main(arguments: Sequence[str] | None = None) -> int:
    """Serve as the command line, or `arguments`, says; returns the exit code."""
    parser = _Parser(prog="python -m hardware.emulator", description=__doc__)
    parser.add_argument("--host", default=EmulatorConfig.host, help="address to listen on")
    parser.add_argument("--paced", action="store_true", help="1 kHz by the wall clock, as a robot")
    parser.add_argument("--table-z", type=float, help="height of a table under the hand [m]")
    parser.add_argument(
        "--object-width", type=float, default=0.0, help="of what every grasp finds [m]"
    )
    parser.add_argument(
        "--chain", type=int, metavar="SEED", help="a bead chain on foam, instead of table or object"
    )
    try:
        options = parser.parse_args(arguments)
        config = EmulatorConfig(host=options.host, paced=options.paced)
        world: World = TableWorld(table_z=options.table_z, object_width=options.object_width)
        if options.chain is not None:
            if options.table_z is not None or options.object_width:
                raise InputError("--chain brings its own table and object: leave the others out")
            from ..twin import CableTwin, TwinConfig  # loads the simulator

            world = CableTwin(TwinConfig(seed=options.chain))
        pace = "1 kHz" if config.paced else "in lock-step"
        print(f"emulated Panda on {config.host}, {pace}; Ctrl-C ends it", file=sys.stderr)
        serve_emulator(config, world=world)
    except KeyboardInterrupt:
        return 130
    except WarpDeformError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2 if isinstance(error, InputError) else 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
