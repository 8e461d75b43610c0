"""The error types that every part of warp-deform raises for its users."""

from __future__ import annotations

__all__ = ["InputError", "Interrupted", "WarpDeformError"]


class WarpDeformError(Exception):
    """Base of every error that this package raises on purpose."""


class InputError(WarpDeformError, ValueError):
    """Something that a user handed in is wrong: a name, a file, an action, a configuration.

    The message is one line that says what was wrong and what to do. The command line prints it on
    stderr and exits with code 2.
    """


class Interrupted(KeyboardInterrupt):
    """Ctrl-C in work that knows what it leaves: the message says what is kept, and what to do."""
