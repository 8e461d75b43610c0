"""Thousands of random and adversarial commands through `SafeRobot`: are all written limits kept?

`tests/shared/fixtures/safety_fuzzing.py` says what is commanded and judged; the tests give a few
hundred.

    python benchmarks/safety_fuzz.py [--commands 5000] [--seed 0] [--json FILE]
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "shared"))
from fixtures.safety_fuzzing import fuzz


@dataclass(frozen=True)
class Options:
    """What to try."""

    commands: int = 5000  # to give
    seed: int = 0  # of the commands
    json: Path | None = None  # file for the result


def main(options: Options) -> None:
    """Try and print."""
    record = fuzz(options.commands, seed=options.seed).record()
    text = json.dumps({"seed": options.seed, **record}, indent=1)
    print(text)
    if options.json is not None:
        options.json.write_text(text + "\n")


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
