"""Actions found by simulation: try them from a saved state, and search for better ones."""

from .action_search import METHODS, SearchConfig, search
from .lookahead import Lookahead, Outlook, lookahead_for

__all__ = ["METHODS", "Lookahead", "Outlook", "SearchConfig", "lookahead_for", "search"]
