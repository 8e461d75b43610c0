"""The session of `warp-deform view`: recorded episodes, simulated again while they are watched.

Every state is compared with the recorded one. Motions are computed one action at a time, when a
page asks for the next: a page that does not keep up asks for less.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from ..errors import InputError
from ..rendering.pixels import BOUNDS
from ..tasks.registry import task as find_task
from ..worlds.state import WorldState
from ..worlds.worlds import Worlds
from .access import StaticFile
from .drawing import FRAMES_A_SECOND, arm_arrays, clip, grid_head, pictures
from .fault import Fault, where_it_broke
from .server import Post
from .sources import Shown, Source
from .telling import scene_arrays, state_head, state_pictures
from .wire import Job, Verbs, pack

__all__ = ["ViewSession"]

MOST_THUMBNAILS = 24
"""Pictures that one message asks for."""
_MOST_WORLDS, _MOST_REPLAYS = 2, 4


class _Replay:
    """An episode while it is simulated again.

    Attributes:
        done: actions that were carried out
        outcome: of the last of them
        fault: where it broke the physics
        state: after them
    """

    def __init__(self, worlds: Worlds, shown: Shown) -> None:
        self.worlds, self.shown, self.done = worlds, shown, 0
        self.outcome: str | None = None
        self.fault: Fault | None = None
        goals = {} if shown.goal is None else {0: shown.goal}
        worlds.reset({0: shown.seed}, goals=goals)
        self.state: WorldState = worlds.state(0)

    @property
    def same(self) -> bool | None:
        """Whether the present state is the recorded one, bit for bit; None without a record."""
        hashes = self.shown.hashes
        return self.worlds.hash(0) == hashes[self.done] if self.done < len(hashes) else None

    def head(self) -> dict[str, Any]:
        """What is told of the present state."""
        return {
            **state_head(self.worlds, self.fault),
            "t": self.done,
            "last": self.done == len(self.shown.actions),
            "same": self.same,
            "outcome": self.outcome,
        }

    def pictures(self) -> dict[str, np.ndarray]:
        """The observation, and the goal where there is one."""
        return state_pictures(self.worlds, height=False)

    def step(self) -> tuple[dict[str, np.ndarray], float] | None:
        """Carry out the next action; its motion, None where nothing moved."""
        self.worlds.restore(0, self.state)
        waiting = self.worlds.episodes[0].posture.copy()
        action = self.shown.actions[self.done]
        report = self.worlds.step({0: action}, record=1.0 / FRAMES_A_SECOND)[0]
        self.outcome = report.outcome.value
        self.done += 1
        self.state = self.worlds.state(0)
        episode = self.worlds.episodes[0]
        moved = clip(self.worlds.robot, report, waiting, episode.snapshot)
        if moved is not None and not episode.physics_ok:
            self.fault = where_it_broke(episode.drawables, moved[0]["q"], 1.0 / FRAMES_A_SECOND)
        return moved


class ViewSession:
    """Episodes of a source; see `server.Session`. What a page opens is its own affair."""

    files: Mapping[str, StaticFile] = {"": StaticFile("view.html")}
    verbs: Verbs = {
        "thumbnails": {"keys": list},
        "open": {"key": int, "side": int},
        "clip": {"key": int, "side": int, "t": int},
    }
    urgent: frozenset[str] = frozenset()

    def __init__(self, source: Source) -> None:
        self.stop = threading.Event()
        self.source = source
        self.entries = source.entries()
        self._worlds: OrderedDict[tuple[str, str], Worlds] = OrderedDict()
        self._replays: OrderedDict[tuple[int, int], _Replay] = OrderedDict()

    def greet(self) -> list[bytes]:
        """See `Session.greet`."""
        entries = [asdict(entry) for entry in self.entries]
        return [
            pack(
                "hello",
                title=self.source.title,
                at_once=self.source.at_once,
                frames=FRAMES_A_SECOND,
                entries=entries,
            )
        ]

    def do(self, job: Job, post: Post) -> None:
        """See `Session.do`."""
        for message in getattr(self, f"_do_{job.do}")(job):
            post(message, everyone=False)

    def _do_thumbnails(self, job: Job) -> list[bytes]:
        keys = job.values["keys"]
        if len(keys) > MOST_THUMBNAILS:
            raise InputError(f"at most {MOST_THUMBNAILS} pictures at a time")
        arrays = {}
        for key in keys:
            entry = self.entries[self._key(key)]
            color = None if entry.trouble else self.source.thumbnail(entry.key)
            if color is not None:
                arrays[str(entry.key)] = pictures(color)["color"]
        return [pack("thumbnails", arrays)]

    def _key(self, key: object) -> int:
        if type(key) is not int or not 0 <= key < len(self.entries):
            raise InputError(f"there is no episode {str(key)[:20]} in this list")
        return key

    def _do_open(self, job: Job) -> list[bytes]:
        key, side = self._key(job.values["key"]), job.values["side"]
        if side not in (0, 1):
            raise InputError("an episode is shown on side 0 or 1")
        entry = self.entries[key]
        if entry.trouble:
            raise InputError(entry.trouble)
        shown = self.source.show(key)
        about: dict[str, Any] = {
            "key": key,
            "side": side,
            "entry": asdict(entry),
            "count": len(shown.actions),
            "actions": [[float(x) for x in action] for action in shown.actions],
            "outcomes": list(shown.outcomes),
        }
        if len(shown.pictures):
            arrays = {f"color{t}": pictures(c)["color"] for t, c in enumerate(shown.pictures)}
            if shown.goal is not None:
                arrays |= pictures(goal=shown.goal.color)
            return [pack("pictures", arrays, scores=list(map(float, shown.scores)), **about)]
        replay = self._begin(key, side, shown)
        worlds = replay.worlds
        arm, parts = arm_arrays(worlds.robot)
        furniture = {
            "parts": parts,
            "grid": grid_head(worlds.task.grid),
            "bounds": BOUNDS[:2],
            "instruction": worlds.task.instruction,
        }
        arrays = {**scene_arrays(worlds), **replay.pictures(), **arm}
        return [pack("scene", arrays, **about, **furniture, **replay.head())]

    def _begin(self, key: int, side: int, shown: Shown) -> _Replay:
        task = find_task(shown.task)
        kind = shown.task, shown.robot
        if kind not in self._worlds:
            self._worlds[kind] = Worlds(task, 1, robot=shown.robot)
        self._worlds.move_to_end(kind)
        while len(self._worlds) > _MOST_WORLDS:
            self._worlds.popitem(last=False)
        replay = self._replays[key, side] = _Replay(self._worlds[kind], shown)
        self._replays.move_to_end((key, side))
        while len(self._replays) > _MOST_REPLAYS:
            self._replays.popitem(last=False)
        return replay

    def _do_clip(self, job: Job) -> list[bytes]:
        """The motion of action t of an episode that was opened; asked for in their order."""
        key, side, t = (job.values[name] for name in ("key", "side", "t"))
        replay = self._replays.get((self._key(key), side))
        if replay is None or t != replay.done:  # another tab watches it, or it was put away
            replay = self._begin(key, side, self.source.show(key))
            while replay.done < min(t, len(replay.shown.actions)):
                replay.step()
        if not 0 <= t < len(replay.shown.actions):
            raise InputError(f"the episode has {len(replay.shown.actions)} actions")
        moved = replay.step()
        head = {"key": key, "side": side, **replay.head()}
        if moved is None:
            return [pack("still", replay.pictures(), **head)]
        arrays, end = moved
        return [pack("clip", {**arrays, **replay.pictures()}, end=end, **head)]
