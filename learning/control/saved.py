"""An actor in files: numbers as safetensors, and beside them JSON that says whose they are."""

from __future__ import annotations

from pathlib import Path
from typing import Any, get_args

from torch import nn

from warp_deform.errors import InputError

from ..runs.folder import RunFolder, read_snapshot
from .actor import Actor, PlanActor
from .settings import GradientMethod

__all__ = ["load_actor", "save_actor"]

_METHODS = sorted(get_args(GradientMethod))


def save_actor(
    folder: Path, actor: Actor | PlanActor, *, task: str, method: str, updates: int
) -> Path:
    """Write an actor after so many updates into a folder, each file whole or not at all.

    Args:
        method: that trained it, "apg", "shac" or "plan"
    """
    run = RunFolder(folder)
    run.create()
    sizes = [each.in_features for each in actor.network if isinstance(each, nn.Linear)]
    config: dict[str, Any] = {"size": sizes[0], "hidden": sizes[1:]}
    if isinstance(actor, PlanActor):
        config["steps"] = actor.steps
    record = {"agent": {"task": task, "agent": method, "config": config}}
    return run.write_snapshot(updates, actor.state_dict(), record)


def load_actor(path: Path) -> tuple[Actor | PlanActor, str]:
    """The actor of a snapshot's file, and the task that it was trained for.

    Raises:
        InputError: the file is missing or damaged, or holds no actor.
    """
    weights, record = read_snapshot(Path(path))
    about = record["agent"]
    try:
        if about["agent"] not in _METHODS:
            raise ValueError(f"it is of the agent {about['agent']}")
        config = about["config"]
        size, hidden = config["size"], tuple(config["hidden"])
        actor: Actor | PlanActor
        if about["agent"] == "plan":
            actor = PlanActor(size, hidden, steps=config["steps"])
        else:
            actor = Actor(size, hidden)
        actor.load_state_dict(weights)
        if not all(bool(each.isfinite().all()) for each in weights.values()):
            raise ValueError("its weights are not finite")
    except (KeyError, RuntimeError, TypeError, ValueError) as error:
        raise InputError(f"{path} holds no actor: {str(error).splitlines()[0]}") from error
    return actor, about["task"]
