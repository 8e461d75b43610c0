"""What the operator's page shows and takes; see `warp_deform.page.server.Session`.

The program tells it what is seen and asked, the page answers, and `replies` has what it said. While
a question is open the program sends beats, and an answer names the latest one that its page had: a
click that was held up on its way, by a tunnel that stood still say, is refused as too old.
"""

from __future__ import annotations

import math
import queue
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from warp_deform.errors import InputError
from warp_deform.page.access import StaticFile
from warp_deform.page.server import Post
from warp_deform.page.wire import Job, Verbs, pack

__all__ = ["STOP", "OperatorSession", "Question"]

STOP = "stop"
"""What ends an episode; it is taken at any time."""
FRESH_S = 3.0
"""Age of the beat that an answer names, above which it is refused [s]."""
HALTS_S = 2.0
"""Time after which a second stop is passed on as well [s]; sooner it would disturb the first."""
_MOST_BEATS, _MOST_LINES = 16, 100


@dataclass(frozen=True)
class Question:
    """What is asked, and the answers that there are.

    Attributes:
        number: of the question, from 1; no two have the same
        which: the sort of question, for the page
        choices: what may be said, and what stands on its button
        plan: of `pictures.plan_head`
    """

    number: int
    which: str
    text: str
    choices: Mapping[str, str]
    plan: Mapping[str, Any] = field(default_factory=dict)


class OperatorSession:
    """One program that asks, and pages that answer.

    Args:
        about: what is told of the program
        halt: stops the arm as Ctrl-C does

    Attributes:
        replies: the number of a question, and what was said: a choice, or two pixels
    """

    files: Mapping[str, StaticFile] = {
        "": StaticFile("operator.html", __package__),
        "operator.js": StaticFile("operator.js", __package__),
        "operator.css": StaticFile("operator.css", __package__),
    }
    verbs: Verbs = {
        "answer": {"question": int, "beat": int, "says": str},
        "point": {"question": int, "beat": int, "pick": list, "place": list},
        "halt": {},
    }
    urgent: frozenset[str] = frozenset({"halt"})

    def __init__(self, about: Mapping[str, Any], halt: Callable[[], None]) -> None:
        self.stop = threading.Event()
        self.replies: queue.SimpleQueue[tuple[int, Any]] = queue.SimpleQueue()
        self._about, self._halt = dict(about), halt
        self._halted = -math.inf
        self._question: Question | None = None
        self._beats: dict[int, float] = {}
        self._beat = 0
        self._seen: tuple[dict[str, np.ndarray], dict[str, Any]] | None = None
        self._plan: np.ndarray | None = None
        self._lines: list[str] = []
        self._over = ""

    def greet(self) -> list[bytes]:
        """See `Session.greet`."""
        messages = [pack("hello", **self._about, lines=self._lines, over=self._over)]
        if self._seen is not None:
            messages.append(self._look())
        if self._question is not None:
            messages.append(self._ask(self._question))
        return messages

    def do(self, job: Job, post: Post) -> None:
        """See `Session.do`."""
        getattr(self, f"_do_{job.do}")(job, post)

    # What the program tells

    def _do_look(self, job: Job, post: Post) -> None:
        self._seen, self._plan = (job.values["pictures"], job.values["head"]), None
        post(self._look())

    def _look(self) -> bytes:
        assert self._seen is not None
        return pack("look", self._seen[0], **self._seen[1])

    def _do_ask(self, job: Job, post: Post) -> None:
        self._question, self._plan = job.values["question"], job.values["drawn"]
        self._beats.clear()
        assert self._question is not None
        post(self._ask(self._question))

    def _ask(self, question: Question) -> bytes:
        drawn = {} if self._plan is None else {"plan": self._plan}
        return pack("ask", drawn, **{k: v for k, v in vars(question).items() if k != "plan"},
                    **question.plan)  # fmt: skip

    def _do_beat(self, job: Job, post: Post) -> None:
        if self._question is None:
            return
        self._beat += 1
        self._beats[self._beat] = time.monotonic()
        while len(self._beats) > _MOST_BEATS:
            del self._beats[next(iter(self._beats))]
        post(pack("beat", question=self._question.number, beat=self._beat))

    def _do_withdraw(self, job: Job, post: Post) -> None:
        """A question that nobody waits for any more."""
        if self._question is not None and self._question.number == job.values["number"]:
            self._question = None
            post(pack("closed", number=job.values["number"], said=""))

    def _do_line(self, job: Job, post: Post) -> None:
        self._lines = [*self._lines, job.values["text"]][-_MOST_LINES:]
        post(pack("line", text=job.values["text"]))

    def _do_over(self, job: Job, post: Post) -> None:
        self._question, self._over = None, job.values["text"]
        post(pack("over", text=self._over))

    # What a page says

    def _do_answer(self, job: Job, post: Post) -> None:
        question, says = self._asked(job), job.values["says"]
        if says not in question.choices:
            raise InputError(f"{says[:20]!r} is no answer to this question")
        if says != STOP:
            self._check_beat(job)
        self._take(says, question.choices[says], post)

    def _do_point(self, job: Job, post: Post) -> None:
        question = self._asked(job)
        if question.which != "point":
            raise InputError("nobody asked for a point")
        points = [tuple(job.numbers(name, 2)) for name in ("pick", "place")]
        self._check_beat(job)
        self._take(points, "pointed", post)

    def _do_halt(self, job: Job, post: Post) -> None:
        """Stop, whatever is asked or moves; what an open question takes for a no is answered so."""
        if self._over:
            raise InputError("it has ended already")
        if self._question is not None:
            self._take(STOP, "stopped", post)
            return
        if time.monotonic() - self._halted < HALTS_S:
            raise InputError("a stop was asked for already; if the arm moves on, press Stop again")
        self._halted = time.monotonic()
        self._halt()
        self._do_line(Job("line", {"text": "Stop was pressed at the page"}), post)

    def _asked(self, job: Job) -> Question:
        """The open question, if it is the one that is answered."""
        question = self._question
        if question is None or question.number != job.values["question"]:
            raise InputError("that question is not open any more; nothing was done with the answer")
        return question

    def _check_beat(self, job: Job) -> None:
        issued = self._beats.get(job.values["beat"])
        if issued is None or time.monotonic() - issued > FRESH_S:
            raise InputError(
                f"the answer was more than {FRESH_S:g} s on its way and does not count; look at "
                "the arm, then answer again"
            )

    def _take(self, says: Any, words: str, post: Post) -> None:
        assert self._question is not None
        number, self._question = self._question.number, None
        self.replies.put((number, says))
        post(pack("closed", number=number, said=words))
