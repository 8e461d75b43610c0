"""The peers by the names that `warp-deform bench --peer` takes, and the scenes that each runs."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from ..errors import InputError
from .mujoco_peer import time_mujoco
from .mujoco_soft import time_mujoco_soft
from .newton_peer import NEWTON_SOLVERS, time_newton
from .newton_soft import time_newton_soft
from .pybullet_peer import time_pybullet
from .pybullet_soft import time_pybullet_soft
from .scene import PEER_SCENES
from .soft_scene import SOFT_SCENES
from .timing import PeerTiming

__all__: list[str] = []  # `warp_deform.peers` is the import path of what is here

PEERS: dict[str, Callable[..., PeerTiming]] = {
    "pybullet": time_pybullet,
    "mujoco": time_mujoco,
    **{f"newton-{name}": partial(time_newton, solver=name) for name in NEWTON_SOLVERS},
}
SOFT_PEERS: dict[str, Callable[..., PeerTiming]] = {
    "pybullet": time_pybullet_soft,
    "mujoco": time_mujoco_soft,
    "newton-vbd": time_newton_soft,
}
"""Those that also run `SOFT_SCENES`: fabrics and bags with self-contact."""


def check_peer(peer: str, scene: str) -> None:
    """Refuse a peer that is unknown or does not run `scene`.

    Raises:
        InputError: no such peer or scene, or not this one on that one.
    """
    if peer not in PEERS:
        raise InputError(f"no peer is called {peer!r}; choose from {', '.join(PEERS)}")
    if scene in SOFT_SCENES:
        if peer not in SOFT_PEERS:
            raise InputError(
                f"{peer} does not run the scene {scene!r}; choose from {', '.join(SOFT_PEERS)}"
            )
    elif scene not in PEER_SCENES:
        known = ", ".join((*PEER_SCENES, *SOFT_SCENES))
        raise InputError(f"no peer scene is called {scene!r}; choose from {known}")


def time_peer(
    peer: str, scene: str, *, seconds: float | None = None, repeats: int = 5
) -> PeerTiming:
    """CPU cost of `scene` in "pybullet", "newton-vbd" and so on.

    Args:
        scene: one of `PEER_SCENES`, or one of `SOFT_SCENES` for a peer in `SOFT_PEERS`
        seconds: simulated time of one measurement [s]; None: 1 s, or the whole play of a soft scene
        repeats: number of starts; of soft scenes three at most are played

    Raises:
        InputError: an argument is unknown or out of range, or PyBullet is not installed.
    """
    check_peer(peer, scene)
    if scene in SOFT_SCENES:
        return SOFT_PEERS[peer](scene, seconds=seconds, repeats=repeats)
    return PEERS[peer](scene, seconds=1.0 if seconds is None else seconds, repeats=repeats)
