"""How a recorded episode failed, as far as its rows alone tell."""

from __future__ import annotations

from warp_deform.episodes import Episode

from ..evaluation.failures import puts_back, took_nothing

__all__ = ["kind_of"]


def kind_of(episode: Episode) -> str:
    """Which of `evaluation.summary.FAILURES` an episode is; empty if it succeeded.

    Those of bags ask the simulator, so here such an episode is "other".
    """
    if episode.info.success:
        return ""
    if not episode.info.physics_ok:
        return "physics"
    if took_nothing([step.outcome for step in episode.steps if step.outcome is not None]):
        return "missed grasp"
    actions = [step.action for step in episode.steps if step.action is not None]
    return "back and forth" if puts_back(actions) else "other"
