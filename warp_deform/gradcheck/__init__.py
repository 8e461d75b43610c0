"""Checks of the solver's derivatives against finite differences, in states of real episodes."""

from .report import GradcheckConfig, Row, check
from .summary import Summary, summarise

__all__ = ["GradcheckConfig", "Row", "Summary", "check", "summarise"]
