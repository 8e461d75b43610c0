"""What a simulated second costs: a lone world, and a world among many in SIMD lanes.

Process CPU time, kernels compiled before. Every start is different: a figure is the median over
starts for the lone world, and of repeated launches for the 64 worlds in lanes. "Falling" is the
time from the start, "rest" the time after two simulated seconds; a peer is timed in the same run,
on the same starts, and ratios compare like with like.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ..errors import InputError
from ..peers import PEER_SCENES, check_peer, time_peer
from .bag import BAG_SCENES, run_bag
from .cloth import CLOTH_SCENES, run_cloth
from .rigid import run_rigid

__all__ = ["SCENES", "run"]

_SOFT_SCENES: dict[str, Callable[..., dict[str, Any]]] = {
    **dict.fromkeys(CLOTH_SCENES, run_cloth),
    **dict.fromkeys(BAG_SCENES, run_bag),
}
"""What times our side of each scene with a play of its own."""
SCENES = (*PEER_SCENES, *_SOFT_SCENES)
"""Names that `run` knows."""
_EDGES = "-edges"  # our edge contact on or off: the peers have one scene for both


def run(
    *,
    scene: str = "cable",
    peer: str | None = None,
    lanes: int = 8,
    worlds: int = 64,
    seconds: float | None = None,
    repeats: int = 5,
) -> dict[str, Any]:
    """Time `scene` ("cable", "heap", "ring", "block", "tower", a sheet or a bag), and `peer` too.

    The fabrics are those of `bench.cloth`, with at most 16 worlds (4 of 50 rows); their figure is
    the mean over settling, one fold and lying folded, ours and the peer's.

    Args:
        seconds: simulated time of one measurement [s]; None: 1 s, or the whole play of a fabric or
            a bag, which `seconds` cuts short for a peer alone

    Returns:
        Times in process CPU milliseconds per simulated second and world, `ratio` and `ratio_lanes`
        (peer's time over ours, falling; `rest_ratio` at rest) and `same_bits`: whether the worlds
        in lanes ended in the very states they end in alone.

    Raises:
        InputError: no such scene or peer, or the peer is not installed.
        PhysicsError: a guard fired.
    """
    if scene not in SCENES:
        raise InputError(f"no scene {scene!r} to time; choose from {', '.join(SCENES)}")
    if peer is not None:
        check_peer(peer, scene.removesuffix(_EDGES))
    if not ((seconds is None or seconds > 0) and repeats > 0 and worlds > 0):
        raise InputError("seconds, repeats and worlds must be positive")
    if scene in _SOFT_SCENES:
        report = _SOFT_SCENES[scene](scene=scene, lanes=lanes, worlds=worlds, repeats=repeats)
    else:
        length = 1.0 if seconds is None else seconds
        report = run_rigid(scene=scene, lanes=lanes, worlds=worlds, seconds=length, repeats=repeats)
    if peer is not None:
        theirs = time_peer(peer, scene.removesuffix(_EDGES), seconds=seconds, repeats=repeats)
        report |= theirs.report()
        report |= _ratios(report)
    return report


def _ratios(report: dict[str, Any]) -> dict[str, float]:
    """The peer's times over ours; a peer cut short has no time at rest."""
    return {
        f"{kind}ratio{many}": report[f"peer_{kind}ms_per_sim_second"]
        / report[f"{kind}ms_per_sim_second{many}"]
        for kind in ("", "rest_")
        for many in ("", "_lanes")
        if f"peer_{kind}ms_per_sim_second" in report
    }
