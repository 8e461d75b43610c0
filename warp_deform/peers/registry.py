"""The peers by the names that `warp-deform bench --peer` takes."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from ..errors import InputError
from .newton_peer import NEWTON_SOLVERS, time_newton
from .pybullet_peer import time_pybullet
from .timing import PeerTiming

__all__: list[str] = []  # `warp_deform.peers` is the import path of what is here

PEERS: dict[str, Callable[..., PeerTiming]] = {
    "pybullet": time_pybullet,
    **{f"newton-{name}": partial(time_newton, solver=name) for name in NEWTON_SOLVERS},
}


def time_peer(peer: str, scene: str, *, seconds: float = 1.0, repeats: int = 5) -> PeerTiming:
    """CPU cost of `scene`, one of `PEER_SCENES`, in "pybullet", "newton-vbd" and so on.

    Raises:
        InputError: an argument is unknown or out of range, or PyBullet is not installed.
    """
    if peer not in PEERS:
        raise InputError(f"no peer is called {peer!r}; choose from {', '.join(PEERS)}")
    return PEERS[peer](scene, seconds=seconds, repeats=repeats)
