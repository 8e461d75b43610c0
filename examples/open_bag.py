"""Open a crumpled bag: the visible demonstrator pulls its rim apart, one bead at a time.

python examples/open_bag.py [--seed 0] [--out bag.png]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import gymnasium
import numpy as np

import warp_deform  # noqa: F401  registers the ids
from warp_deform.quiet import quiet_warp
from warp_deform.rendering.video import write_png


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seed", type=int, default=0, help="names the episode")
    parser.add_argument("--out", type=Path, help="pictures from above, before and after (PNG)")
    options = parser.parse_args()

    quiet_warp()
    env = gymnasium.make("WarpDeform/BagAloneOpen-v2").unwrapped
    observation, info = env.reset(seed=options.seed)
    before = observation["color"]
    print(f"the opening is {info['score']:.0%} of the circle that it was")
    terminated = truncated = False
    while not (terminated or truncated) and (action := env.demonstrate("visible")) is not None:
        observation, reward, terminated, truncated, info = env.step(action)
        print(f"{info['outcome']}: {info['score']:.0%} ({reward:+.2f})")
    assert info["success"], "the bag is not open; another seed may be easier"

    if options.out is not None:
        write_png(options.out, np.concatenate([before, observation["color"]], axis=1))
        print(f"wrote {options.out}")


if __name__ == "__main__":
    main()
