"""Starting Warp without its remarks, for the command line and its worker processes."""

from __future__ import annotations

import os
import sys
import tempfile

from .errors import WarpDeformError

__all__ = ["quiet_warp"]

_NO_DRIVER = "Could not find or load the NVIDIA CUDA driver"


def quiet_warp() -> None:
    """Start Warp; of what it says, only errors and the unexpected reach stderr.

    Left out are its greeting, its notes on compiled modules, and that there is no CUDA driver: no
    news on a laptop, but its native code says so in every process, whatever the log level.
    `warp-deform doctor` tells which devices there are.

    Raises:
        WarpDeformError: Warp cannot make the folder in which it keeps compiled kernels.
    """
    import warp

    warp.config.log_level = warp.LOG_ERROR
    sys.stderr.flush()
    stderr = os.dup(2)
    with tempfile.TemporaryFile() as said:
        os.dup2(said.fileno(), 2)
        try:
            warp.init()
        except OSError as error:
            raise WarpDeformError(
                f"Warp cannot start: {error}; it keeps compiled kernels in a folder that it "
                "must be able to write to: set WARP_CACHE_PATH to one"
            ) from error
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
            said.seek(0)
            for line in said.read().decode(errors="replace").splitlines():
                if _NO_DRIVER not in line:
                    print(line, file=sys.stderr)
