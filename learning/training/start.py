"""What training begins with: random weights, or those of a run that was trained before."""

from __future__ import annotations

import hashlib
from dataclasses import asdict
from typing import Any

from warp_deform.errors import InputError

from ..policy.policy import Agent, AgentDescription, make_agent
from ..runs.folder import RunFolder, read_snapshot
from .config import TrainConfig

__all__ = ["begin"]

_FREE = "bfloat16"
"""Setting of a network in which the weights' meaning does not change."""


def begin(config: TrainConfig, description: AgentDescription) -> tuple[Agent, str | None]:
    """The agent with the weights that training begins with, and the digest of a run's.

    Raises:
        InputError: the run that is named has no snapshot, or is of another agent.
    """
    agent = make_agent(description, seed=config.seed)
    if config.start is None:
        return agent, None
    snapshot = RunFolder(config.start).chosen_snapshot()
    weights, record = read_snapshot(snapshot)
    theirs, ours = _network(record["agent"]), _network(asdict(description))
    different = next((key for key in ours if theirs.get(key) != ours[key]), None)
    if different is not None:
        raise InputError(
            f"--start {config.start} has another {different} than this run; start from a run of "
            "the same task, agent and preset"
        )
    try:
        agent.load_state_dict(weights)
    except RuntimeError as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"{snapshot} does not fit the agent: {reason}") from error
    return agent, hashlib.blake2b(snapshot.read_bytes(), digest_size=16).hexdigest()


def _network(agent: dict[str, Any]) -> dict[str, Any]:
    """What a network is, by name, in JSON types."""
    config = {key: each for key, each in agent["config"].items() if key != _FREE}
    parts = {key: list(each) if isinstance(each, tuple) else each for key, each in config.items()}
    return {**agent, "config": None, "cosines_less_one": False, **parts}
