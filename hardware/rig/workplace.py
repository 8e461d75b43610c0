"""The home pose and workspace in force: what the setup's folder holds, or what flags say."""

from __future__ import annotations

from ..calibration.workplace import Workplace
from .config import RigConfig

__all__ = ["workplace_of"]


def workplace_of(config: RigConfig) -> Workplace:
    """Return a setup's home pose and workspace: what is stored, with what the flags say instead.

    Raises:
        InputError: the arm cannot work so, or the stored file is damaged
    """
    stored = Workplace.load(config.setup) or Workplace()
    return stored.with_flags(config.home, config.workspace)
