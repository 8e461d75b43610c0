"""How the optional parts are installed; no registry has the package, so from a clone of it."""

from __future__ import annotations

__all__ = ["install_extra"]


def install_extra(extra: str) -> str:
    """The command that installs an extra of pyproject.toml, to be run in a clone's folder.

    Examples:
        >>> install_extra("ray")
        "pip install -c constraints.txt -e '.[ray]'"
    """
    return f"pip install -c constraints.txt -e '.[{extra}]'"
