"""What counts as the goal of a demonstration, by name. Importing this loads nothing."""

from typing import Literal

__all__ = ["GoalName"]

GoalName = Literal["end", "own"]
"""How the demonstration ended (hindsight), or the goal of its own that it was recorded with."""
