"""Where a page in the browser is served: flags of every verb that has one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

from tyro.conf import arg

from ..errors import InputError
from ..support.flag_range import FlagRange
from .main import CommandOptions

__all__ = ["PageOptions"]


@dataclass(frozen=True, kw_only=True)
class PageOptions(CommandOptions):
    """Where the page is served."""

    port: Annotated[int, arg(metavar="P"), FlagRange(0, 65535)] = 0
    """Port of the loopback interface; 0 takes any that is free."""
    browser: bool = False
    """Open the page in this machine's browser."""

    def opener(self) -> Callable[[str], object] | None:
        """What opens an address, where that was asked for.

        Raises:
            InputError: this machine has no browser that Python knows of.
        """
        if not self.browser:
            return None
        import webbrowser

        try:
            return webbrowser.get().open
        except webbrowser.Error as error:
            raise InputError(
                "no browser was found; leave --browser out and open the address by hand"
            ) from error
