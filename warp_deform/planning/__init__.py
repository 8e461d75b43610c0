"""Actions found by simulation: try them from a saved state, and search for better ones."""

from .lookahead import Lookahead, Outlook, lookahead_for
from .search import METHODS, SearchConfig, search

__all__ = ["METHODS", "Lookahead", "Outlook", "SearchConfig", "lookahead_for", "search"]
