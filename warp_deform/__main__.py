"""`python -m warp_deform` is the `warp-deform` command."""

import sys

from .cli import main

sys.exit(main())
