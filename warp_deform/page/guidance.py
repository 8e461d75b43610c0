"""What others would do, and what the adjoint says: shown to the person, without acting for them."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np

from ..planning.gradients import gradients_for
from ..tasks.task import Action, Task
from ..worlds.episode import DEMONSTRATOR_STREAM, episode_rng
from ..worlds.loop import EpisodeRun
from ..worlds.spaces import check_action
from ..worlds.worlds import Worlds
from .contest import Standing
from .drawing import heat_picture
from .players import Player
from .server import Post
from .wire import pack

__all__ = ["at_work", "has_gradients", "play_alone", "pull_of_place", "sight_message"]

REACH = 0.06
"""Length of the arrow that shows a gradient [m]."""


@contextlib.contextmanager
def at_work(who: str, post: Post) -> Iterator[None]:
    """Say on every page who is at work."""
    post(pack("work", who=who))
    try:
        yield
    finally:
        post(pack("work", who=""))


def sight_message(player: Player, worlds: Worlds, action: Action, *, acts: bool = False) -> bytes:
    """What somebody would do, or is about to do, and its heat maps where it has any."""
    sight = player.sight(worlds, action)
    maps = {} if sight is None else {k: heat_picture(v) for k, v in vars(sight).items()}
    return pack("sight", maps, who=player.name, action=[float(each) for each in action], acts=acts)


def play_alone(player: Player, worlds: Worlds, seed: int, stop: threading.Event) -> Standing | None:
    """Play the episode that starts in slot 0 to its end; None if it was stopped."""
    player.begin()
    task, episode = worlds.task, worlds.episodes[0]
    run: EpisodeRun[Any] = EpisodeRun(seed, episode_rng(seed, DEMONSTRATOR_STREAM))
    while len(run.actions) < task.max_actions and not (worlds.solved(0) or episode.ended):
        if stop.is_set():
            return None
        action = player.choose(worlds, run)
        if action is None:
            break
        report = worlds.step({0: check_action(action, name=player.name)})[0]
        run.actions.append(np.array(action, dtype=float))
        run.outcomes.append(report.outcome.value)
        episode = worlds.episodes[0]
        if not episode.physics_ok:
            break
    return Standing(float(worlds.score(0)), len(run.actions), worlds.solved(0))


def has_gradients(task: Task) -> bool:
    """Whether the place of the task's actions can be differentiated by."""
    return task.has_loss() and task.jaw is None


def pull_of_place(worlds: Worlds, action: Action) -> dict[str, Any]:
    """Where the task's loss after an action falls fastest, seen from the action's place.

    `to`: the end of an arrow from there, None without a usable gradient; `says`: a line about it.
    The loss is in the task's own unit, the gradient by metres of the place.
    """
    gradients = gradients_for(worlds.task, worlds.robot.name, worlds.precision)
    [found] = gradients.of([(worlds.state(0), action)])
    slope = found.by_place[:2]
    steep = float(np.hypot(*slope))
    if not found.usable:
        return {"to": None, "says": "the tip takes nothing there, so there is nothing to pull"}
    if steep == 0.0:
        return {"to": None, "says": "level: the place changes nothing of what is left to do"}
    to = action[3:5] - REACH * slope / steep
    says = f"the loss is {found.loss:.4g} and falls by {0.01 * steep:.2g} over the first cm"
    if found.growth > 100:
        says += "; the motion is chaotic, so trust it little"
    return {"to": [float(each) for each in to], "says": says}
