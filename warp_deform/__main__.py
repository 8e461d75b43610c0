"""`python -m warp_deform` is the `warp-deform` command."""

import sys

from .command.main import main

sys.exit(main())
