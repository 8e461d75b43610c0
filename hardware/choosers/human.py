"""A person at the table: confirms proposals, clears problems, shows where to pick and place."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TextIO

import numpy as np

from warp_deform.errors import InputError, WarpDeformError

from ..arm.pick_place import PickPlaceAction
from ..episodes.episode import Observation
from ..episodes.operators import Answer, Proposal, described
from ..vision.overlay import draw_action
from ..vision.top_down_view import TopDownView
from .simple import tangent_at

__all__ = [
    "HumanChooser",
    "Show",
    "TerminalOperator",
    "ViewPixel",
    "click_pick_and_place",
    "type_pick_and_place",
]

ViewPixel = tuple[float, float]
"""Row and column in the view from above [px]."""
Show = Callable[[np.ndarray, TopDownView], tuple[ViewPixel, ViewPixel] | None]
"""Shows the enlarged view; returns the pixels of pick and place, None to stop."""


class TerminalOperator:
    """A person at a terminal who watches the robot.

    Enter goes ahead, "s" asks for another action, "q" stops; the end of the input stops.

    Args:
        ask: shows a text and returns the answer; default: on stderr and from stdin
    """

    attends = True

    def __init__(self, ask: Callable[[str], str] | None = None) -> None:
        self._ask = ask or _prompt

    def confirm(self, proposal: Proposal) -> Answer:
        """Show what is proposed and wait for an answer."""
        text = described(proposal)
        if proposal.picture is not None:
            text += f"\n  drawn in {proposal.picture}"
        answers = {"": Answer.DO, "s": Answer.SKIP, "q": Answer.STOP}
        while True:
            reply = self._ask(f"{text}\n  Enter: do it, s: another, q: stop > ").strip().lower()
            if reply in answers:
                return answers[reply]

    def go_on(self, problem: WarpDeformError) -> bool:
        """Show the problem and wait until it is cleared, or the episode given up."""
        reply = self._ask(f"{problem}\n  Enter: cleared, go on; q: stop > ")
        return reply.strip().lower() != "q"

    def wait(self, text: str) -> bool:
        """Wait for something to be done by hand; False where the operator stops instead."""
        return self.answer(text, "Enter: done") is not None

    def answer(self, text: str, choices: str) -> str | None:
        """Return what the operator says to a text, "" for Enter; None to stop.

        Args:
            text: what is asked
            choices: what may be said, for people: "Enter: done"
        """
        reply = self._ask(f"{text}\n  {choices}, q: stop > ").strip()
        return None if reply.lower() == "q" else reply


def _prompt(text: str, source: TextIO | None = None) -> str:
    """Ask on stderr; the end of the input counts as "q".

    What was typed at a terminal before the question is no answer to it, and is dropped.
    """
    source = source or sys.stdin
    if source.isatty():
        import termios  # not on every system, and neither is a terminal

        termios.tcflush(source, termios.TCIFLUSH)
    print(text, end="", file=sys.stderr, flush=True)
    line = source.readline()
    return line.rstrip("\n") if line else "q"


class HumanChooser:
    """A person shows where to pick and place; the fingers go across the cable there.

    Args:
        show: shows the enlarged view; returns the pixels of pick and place, None to stop
        view: the workspace
    """

    name = "human"

    def __init__(
        self,
        show: Show,
        *,
        view: TopDownView | None = None,
    ) -> None:
        self._show = show
        self._view = view or TopDownView()

    def reset(self) -> None:
        """Nothing is remembered."""

    def choose(self, seen: Observation) -> PickPlaceAction | None:
        """See `Chooser.choose`."""
        picture = draw_action(seen.view, self._view, mask=seen.mask, goal=seen.goal)
        pixels = self._show(picture, self._view)
        if pixels is None:
            return None
        pick, place = (tuple(self._view.pixel_to_base(np.array(p)).tolist()) for p in pixels)
        yaw = tangent_at(seen.mask, self._view, pick)
        return PickPlaceAction(pick, yaw, place, yaw)


def click_pick_and_place(
    picture: np.ndarray, view: TopDownView
) -> tuple[ViewPixel, ViewPixel] | None:
    """Return the pixels of pick and place, clicked in a window; None where it is closed.

    Raises:
        InputError: there is no display
    """
    import matplotlib

    if matplotlib.get_backend().lower() == "agg":
        raise InputError("there is no display to click on; use --agent typed")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(5, 9))
    axes.imshow(picture)
    axes.set_title("click pick, then place; close to stop")
    clicks = plt.ginput(2, timeout=0)
    plt.close(figure)
    if len(clicks) < 2:
        return None
    scale = picture.shape[0] / view.shape[0]
    pick, place = (((y + 0.5) / scale - 0.5, (x + 0.5) / scale - 0.5) for x, y in clicks)
    return pick, place


def type_pick_and_place(
    picture: np.ndarray, view: TopDownView
) -> tuple[ViewPixel, ViewPixel] | None:
    """Return the pixels of pick and place, typed as "row column row column"; "q" stops."""
    rows, columns = view.shape
    while True:
        reply = _prompt(
            f"pick and place in the newest *_view.png ({columns} x {rows}): "
            "row column row column, or q > "
        )
        if reply.strip().lower() == "q":
            return None
        try:
            pick_row, pick_column, place_row, place_column = map(float, reply.split())
        except ValueError:
            continue
        return (pick_row, pick_column), (place_row, place_column)
