"""Checks of the solver's derivatives against finite differences, in states of real episodes."""

from .report import GradcheckConfig, Row, check

__all__ = ["GradcheckConfig", "Row", "check"]
