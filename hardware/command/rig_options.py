"""The flags that open robot and camera, and who is asked: nobody, a terminal, or a page."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from warp_deform.command.page_options import PageOptions
from warp_deform.errors import InputError

from ..rig.config import RigConfig

if TYPE_CHECKING:
    from ..episodes.operators import Operator
    from ..page.operator import PageOperator

__all__ = ["RigOptions", "interruptible", "operator_page"]


@dataclass(frozen=True, kw_only=True)
class RigOptions(RigConfig, PageOptions):
    """Robot, camera and where their calibration is: what to open."""

    auto: bool = False
    """Do not ask before every action."""
    page: bool = False
    """Show camera, mask and plan in a page in the browser, and ask there and not at the terminal,
    also where nothing but the simulation moves."""

    def operator(self, page: PageOperator | None, *, watched: bool) -> Operator:
        """Whoever is asked.

        Args:
            page: of `operator_page`
            watched: whether a person at the terminal is asked where there is no page
        """
        from ..choosers.human import TerminalOperator
        from ..episodes.operators import Unattended

        if self.auto:
            return Unattended()
        if page is not None:
            return page
        return TerminalOperator() if watched else Unattended()


@contextlib.contextmanager
def operator_page(options: RigOptions, about: Mapping[str, Any]) -> Iterator[PageOperator | None]:
    """Serve the operator's page while the block runs; None without `--page`.

    Args:
        about: what the page says of what is done

    Raises:
        InputError: the extra is missing, or the port is taken
    """
    if not options.page:
        if options.port or options.browser:
            raise InputError("--port and --browser are of the page: give --page, too")
        yield None
        return
    from warp_deform.page.background import serving_beside
    from warp_deform.page.server import check_websockets, listen

    from ..page.operator import PageOperator
    from ..page.session import OperatorSession

    check_websockets()
    opener = options.opener()
    main = threading.main_thread().ident
    assert main is not None
    told = {
        "robot": f"{options.robot_id}{'' if options.moves else ', nothing moves'}",
        "camera": options.camera_id,
        "asks": not options.auto,
        **about,
    }
    session = OperatorSession(told, lambda: signal.pthread_kill(main, signal.SIGINT))
    with (
        interruptible(),
        listen(options.port) as bound,
        serving_beside(session, bound) as served,
    ):
        operator = PageOperator(session, served)
        operator.announce()
        if opener is not None:
            opener(served.access.address)
        try:
            yield operator
        except KeyboardInterrupt:
            operator.over("stopped")
            raise
        except Exception as error:
            operator.over(f"ended with an error: {error}")
            raise


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Let an interrupt end a motion, also where the program was started deaf to it.

    What a script starts in the background ignores SIGINT, and Stop at the page would do nothing.
    """
    before = signal.getsignal(signal.SIGINT)
    if before is not signal.SIG_IGN:
        yield
        return
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
