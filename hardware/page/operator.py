"""A person at the page, who is asked what `TerminalOperator` asks at the terminal."""

from __future__ import annotations

import itertools
import queue
import sys
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from warp_deform.errors import WarpDeformError
from warp_deform.page.server import Served
from warp_deform.page.wire import Job

from ..calibration.calibration import Calibration
from ..cameras.camera import Frame
from ..episodes.episode import Observation
from ..episodes.operators import Answer, Proposal, described
from ..vision.top_down_view import TopDownView
from .pictures import encoded, mask_picture, plan_head
from .session import STOP, OperatorSession, Question

__all__ = ["PageOperator"]

_BEAT_S = 0.4
"""Time between beats while a question is open [s]."""
_ANSWERS = {"yes": Answer.DO, "another": Answer.SKIP, STOP: Answer.STOP}
Pixel = tuple[float, float]


class PageOperator:
    """Asks at the page and waits, for as long as it takes; see `episodes.operators.Operator`.

    No page, a closed one and a lost connection are no answer. Ctrl-C ends the waiting.

    Args:
        session: what the page shows
        served: where it is served
        notify: tells the terminal that something is asked; default: a line on stderr
    """

    attends = True

    def __init__(
        self,
        session: OperatorSession,
        served: Served,
        *,
        notify: Callable[[str], None] | None = None,
    ) -> None:
        self._session, self._served = session, served
        self._notify = notify or (lambda line: print(line, file=sys.stderr, flush=True))
        self._numbers = itertools.count(1)
        self._calibration: Calibration | None = None

    # What is asked

    def confirm(self, proposal: Proposal) -> Answer:
        """Show what is proposed and wait for an answer."""
        plan = {} if self._calibration is None else plan_head(proposal, self._calibration)
        home = proposal.action is None
        choices = {"yes": "Do it", **({} if home else {"another": "Another"}), STOP: "Stop"}
        said = self._ask(
            "home" if home else "plan", described(proposal), choices, plan, proposal.overlay
        )
        return _ANSWERS[said]

    def go_on(self, problem: WarpDeformError) -> bool:
        """Show the problem and wait until it is cleared, or the episode given up."""
        choices = {"yes": "Cleared, go on", STOP: "Stop"}
        return bool(self._ask("problem", str(problem), choices) == "yes")

    def wait(self, text: str) -> bool:
        """Wait for something to be done by hand; False where the operator stops instead."""
        return bool(self._ask("task", text, {"yes": "Done", STOP: "Stop"}) == "yes")

    def keep(self, text: str) -> Answer:
        """Whether what is shown is to be kept, or to be seen once more."""
        choices = {"yes": "Keep it", "another": "Another picture", STOP: "Stop"}
        return _ANSWERS[self._ask("keep", text, choices)]

    def point(self, picture: np.ndarray, view: TopDownView) -> tuple[Pixel, Pixel] | None:
        """Return the pixels of pick and place, clicked in the view from above; None to stop."""
        rows, columns = view.shape
        text = "point in the view from above at what to pick, then at where it goes"
        shape = {"rows": rows, "columns": columns}
        while True:
            said = self._ask("point", text, {STOP: "Stop"}, shape, picture)
            if said == STOP:
                return None
            if all(-0.5 <= r <= rows - 0.5 and -0.5 <= c <= columns - 0.5 for r, c in said):
                return said[0], said[1]
            text = "that is outside of the view; point at what to pick, then at where it goes"

    def _ask(
        self,
        which: str,
        text: str,
        choices: Mapping[str, str],
        plan: Mapping[str, Any] | None = None,
        drawn: np.ndarray | None = None,
    ) -> Any:
        """Ask at the page and return what is said."""
        question = Question(next(self._numbers), which, text, choices, plan or {})
        picture = None if drawn is None else encoded(drawn)
        self._tell("ask", question=question, drawn=picture)
        self._notify(f"{text}\n  asked at the page")  # its address is a secret, told once
        try:
            while True:
                self._tell("beat")
                try:
                    number, said = self._session.replies.get(timeout=_BEAT_S)
                except queue.Empty:
                    continue
                if number == question.number:
                    return said
        finally:
            self._tell("withdraw", number=question.number)

    # What is shown

    def announce(self) -> None:
        """Print where the page is."""
        address = self._served.access.address
        self._notify(f"open {address}   (the operator's page; Ctrl-C here stops the arm)")

    def begin(self, calibration: Calibration) -> None:
        """An episode begins, whose plans are drawn by this calibration."""
        self._calibration = calibration

    def look(self, frame: Frame, seen: Observation, drawn: np.ndarray) -> None:
        """Show what is seen; `drawn` is the view from above with the outlines of the masks."""
        head: dict[str, Any] = {"actions": seen.index, "pixels": int(np.count_nonzero(seen.mask))}
        pictures = {
            "camera": encoded(frame.rgb, photograph=True),
            "above": encoded(drawn),
            "mask": encoded(mask_picture(seen.mask)),
        }
        if seen.goal is not None:
            pictures["goal"] = encoded(mask_picture(seen.goal))
        self._tell("look", pictures=pictures, head=head)

    def say(self, line: str) -> None:
        """Show a line of what goes on."""
        self._tell("line", text=line)

    def over(self, text: str) -> None:
        """Show how it ended, where anybody can still be told."""
        if self._served.broken is None:
            self._tell("over", text=text)

    def _tell(self, do: str, **values: Any) -> None:
        if self._served.broken is not None:
            raise WarpDeformError(
                f"the page is served no more ({self._served.broken}); start again, without --page "
                "to be asked at the terminal"
            ) from self._served.broken
        self._served.tell(Job(do, values))
