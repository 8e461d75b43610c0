"""What training begins with: random weights, or those of a run that was trained before."""

from __future__ import annotations

import hashlib
from dataclasses import asdict

from warp_deform.errors import InputError

from ..policy.policy import Agent, AgentDescription, make_agent
from ..runs.folder import RunFolder, network_settings, read_snapshot
from .config import TrainConfig

__all__ = ["begin"]


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
    described = record["agent"], asdict(description)
    theirs, ours = ({**each, "config": None, **network_settings(each)} for each in described)
    different = next((key for key in ours if theirs.get(key) != ours[key]), None)
    if different is not None:
        raise InputError(
            f"--start {config.start} has another {different} than this run; start from a run of "
            "the same task, agent and preset, or leave it out"
        )
    try:
        agent.load_state_dict(weights)
    except RuntimeError as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"{snapshot} does not fit the agent: {reason}") from error
    return agent, hashlib.blake2b(snapshot.read_bytes(), digest_size=16).hexdigest()
