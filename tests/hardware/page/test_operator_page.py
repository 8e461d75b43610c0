"""The operator's page: what counts as an answer, and that nothing else does."""

from __future__ import annotations

import re
import signal
import threading
from dataclasses import replace

import numpy as np
import pytest
from fixtures.franka_arm import FAR, Arm, episode
from fixtures.franka_episodes import ACTION, CALIBRATION, LIMITS
from fixtures.operator_desk import answer, desk, question, say
from fixtures.page_server import hear
from websockets.exceptions import ConnectionClosed

import hardware.page.session as session_module
from hardware.arm.pick_place import waypoints
from hardware.arm.robot import UserStopped
from hardware.choosers.human import HumanChooser
from hardware.episodes.operators import Answer, Proposal
from hardware.page.pictures import plan_head
from hardware.page.session import OperatorSession
from hardware.vision.top_down_view import TopDownView
from warp_deform.errors import WarpDeformError
from warp_deform.page.access import FILES

PROPOSAL = Proposal(ACTION, waypoints(ACTION, LIMITS.table), None, 1)
PROBLEM = UserStopped("the user stop is pressed")


@pytest.fixture
def at():
    with desk() as desk_:
        desk_.operator.begin(CALIBRATION)
        yield desk_


@pytest.mark.parametrize(
    ("says", "expected"),
    [("yes", Answer.DO), ("another", Answer.SKIP), ("stop", Answer.STOP)],
)
def test_an_answer_is_what_the_button_says(at, says, expected):
    with at.server.tab() as tab:
        asking = at.asking(lambda: at.operator.confirm(PROPOSAL))
        asked = question(tab)
        assert "pick (0.450, 0.000)" in asked["text"] and asked["which"] == "plan"
        assert set(asked["choices"]) == {"yes", "another", "stop"}
        assert [each["name"] for each in asked["way"]] == list(PROPOSAL.poses)
        answer(tab, asked, says)
        assert asking.answer() is expected


def test_a_closed_tab_is_no_answer_and_the_next_one_is_asked_again(at):
    asking = at.asking(lambda: at.operator.confirm(PROPOSAL))
    with at.server.tab() as tab:
        first = question(tab)
    with at.server.tab() as tab:
        tab.socket.close()  # without a word
    with at.server.tab() as tab:
        again = question(tab)
        assert again["number"] == first["number"] and asking.waits
        answer(tab, again, "yes")
        assert asking.answer() is Answer.DO


def test_an_answer_to_an_earlier_question_is_refused(at):
    with at.server.tab() as tab:
        first = at.asking(lambda: at.operator.confirm(PROPOSAL))
        earlier = question(tab)
        answer(tab, earlier, "another")
        assert first.answer() is Answer.SKIP
        answer(tab, earlier, "yes")  # no question is open
        assert "not open any more" in hear(tab, "note")["text"]
        second = at.asking(lambda: at.operator.confirm(replace(PROPOSAL, number=2)))
        now = question(tab)
        answer(tab, {**now, "number": earlier["number"]}, "yes")
        assert "not open any more" in hear(tab, "note")["text"]
        answer(tab, {**now, "beat": earlier["beat"]}, "yes")  # of this question's beats none
        assert "does not count" in hear(tab, "note")["text"]
        assert second.waits
        answer(tab, now, "stop")
        assert second.answer() is Answer.STOP


def test_an_answer_that_was_held_up_on_its_way_does_not_count(at, monkeypatch):
    with at.server.tab() as tab:
        asking = at.asking(lambda: at.operator.confirm(PROPOSAL))
        asked = question(tab)
        with monkeypatch.context() as patch:
            patch.setattr(session_module, "FRESH_S", -1.0)
            answer(tab, asked, "yes")
            assert "look at the arm" in hear(tab, "note")["text"]
        assert asking.waits
        answer(tab, {**asked, "beat": hear(tab, "beat")["beat"]}, "yes")
        assert asking.answer() is Answer.DO


def test_a_late_no_still_stops(at, monkeypatch):
    monkeypatch.setattr(session_module, "FRESH_S", -1.0)
    with at.server.tab() as tab:
        asking = at.asking(lambda: at.operator.confirm(PROPOSAL))
        answer(tab, question(tab), "stop")
        assert asking.answer() is Answer.STOP


def test_of_two_tabs_the_first_answer_counts(at):
    with at.server.tab() as one, at.server.tab() as other:
        asking = at.asking(lambda: at.operator.confirm(PROPOSAL))
        asked = [question(tab) for tab in (one, other)]
        answer(one, asked[0], "stop")
        assert hear(other, "closed")["said"] == "Stop"
        answer(other, asked[1], "yes")
        assert "not open any more" in hear(other, "note")["text"]
        assert asking.answer() is Answer.STOP


def test_stop_is_passed_on_again_where_the_first_did_not_end_it(at, monkeypatch):
    monkeypatch.setattr("hardware.page.session.HALTS_S", 0.0)
    with at.server.tab() as tab:
        hear(tab, "hello")
        for _ in range(2):
            say(tab, do="halt")
            assert "Stop was pressed" in hear(tab, "line")["text"]
    assert at.halts == ["halt"] * 2


def test_stop_is_taken_at_any_time_and_once(at):
    with at.server.tab() as tab:
        hear(tab, "hello")
        asking = at.asking(lambda: at.operator.go_on(PROBLEM))
        question(tab)
        say(tab, do="halt")
        assert asking.answer() is False and at.halts == []
        say(tab, do="halt")  # nothing is asked: it stops what moves
        assert "Stop was pressed" in hear(tab, "line")["text"]
        say(tab, do="halt")
        assert "already" in hear(tab, "note")["text"]
        assert at.halts == ["halt"]
        at.operator.over("solved")
        assert hear(tab, "over")["text"] == "solved"


@pytest.mark.parametrize(
    "raw",
    [
        '{"do": "answer", "question": 1, "says": "yes"}',
        '{"do": "ask", "question": 1}',
        '{"do": "beat"}',
        '{"do": "over", "text": ""}',
        '{"do": "withdraw", "number": 1}',
        '{"do": "look"}',
    ],
)
def test_a_page_cannot_say_what_the_program_says(at, raw):
    asking = at.asking(lambda: at.operator.confirm(PROPOSAL))
    with at.server.tab() as tab, pytest.raises(ConnectionClosed) as closed:
        question(tab)
        tab.send(raw)
        while True:
            tab.recv(timeout=10)
    assert closed.value.rcvd.code == 1003 and asking.waits
    with at.server.tab() as tab:
        answer(tab, question(tab), "stop")
        assert asking.answer() is Answer.STOP


@pytest.mark.parametrize("says", ["YES", "do", "", "pointed"])
def test_another_word_is_no_answer(at, says):
    with at.server.tab() as tab:
        asking = at.asking(lambda: at.operator.wait("toss the cable"))
        asked = question(tab)
        answer(tab, asked, says)
        assert "no answer" in hear(tab, "note")["text"] and asking.waits
        say(tab, do="point", question=asked["number"], beat=asked["beat"], pick=[1, 1],
            place=[2, 2])  # fmt: skip
        assert "nobody asked" in hear(tab, "note")["text"] and asking.waits
        answer(tab, asked, "yes")
        assert asking.answer() is True


def test_a_person_points_at_pick_and_place(at):
    chooser = HumanChooser(at.operator.point)
    view = TopDownView()
    seen = type("Seen", (), {"view": np.zeros((320, 160, 3), np.uint8), "goal": None,
                             "mask": np.zeros((320, 160), bool)})  # fmt: skip
    with at.server.tab() as tab:
        asking = at.asking(lambda: chooser.choose(seen))
        asked = question(tab)
        assert (asked["rows"], asked["columns"]) == view.shape
        say(tab, do="point", question=asked["number"], beat=asked["beat"], pick=[500, 20],
            place=[1, 1])  # fmt: skip
        asked = question(tab)
        assert "outside" in asked["text"] and asking.waits
        say(tab, do="point", question=asked["number"], beat=asked["beat"], pick=[100.0, 40.5],
            place=[200, 80])  # fmt: skip
        action = asking.answer()
        assert action.pick_xy == pytest.approx(view.pixel_to_base(np.array([100.0, 40.5])))
        assert action.place_xy == pytest.approx(view.pixel_to_base(np.array([200.0, 80.0])))
        stopping = at.asking(lambda: chooser.choose(seen))
        answer(tab, question(tab), "stop")
        assert stopping.answer() is None


def test_ctrl_c_ends_the_waiting_and_the_question(at):
    main = threading.main_thread().ident
    threading.Timer(0.3, lambda: signal.pthread_kill(main, signal.SIGINT)).start()
    with at.server.tab() as tab:
        with pytest.raises(KeyboardInterrupt):
            at.operator.confirm(PROPOSAL)
        asked = question(tab)
        assert hear(tab, "closed")["number"] == asked["number"]
        answer(tab, asked, "yes")
        assert "not open any more" in hear(tab, "note")["text"]


def test_a_server_that_broke_ends_the_waiting(at):
    at.server.served.broken = RuntimeError("no more")
    try:
        with pytest.raises(WarpDeformError, match="served no more"):
            at.operator.confirm(PROPOSAL)
    finally:
        at.server.served.broken = None


def test_an_episode_is_run_from_the_page(at, tmp_path):
    """What is seen and planned reaches the page; who looks later is shown the same."""
    arm = Arm()
    with at.server.tab() as tab:
        asking = at.asking(
            lambda: episode(
                tmp_path, arm, [FAR, ACTION, ACTION], operator=at.operator, show=at.operator.look
            )
        )
        seen = hear(tab, "look")
        assert bytes(seen["camera"][:2]) == b"\xff\xd8" and bytes(seen["mask"][:4]) == b"\x89PNG"
        asked = question(tab)
        assert "plan" in asked and arm.count("grasp") == 0
        with at.server.tab() as late:
            assert bytes(hear(late, "look")["above"]) == bytes(seen["above"])
            assert bytes(hear(late, "ask")["plan"]) == bytes(asked["plan"])
        answer(tab, asked, "yes")
        second = question(tab)
        assert arm.count("grasp") == 1 and hear(tab, "beat")
        answer(tab, second, "stop")
        result, _ = asking.answer()
    assert (result.outcomes, result.outcome) == (("placed",), "stopped")
    assert arm.count("grasp") == 1


def test_a_plan_is_drawn_where_it_leads():
    way = plan_head(PROPOSAL, CALIBRATION)["way"]
    heights = {each["name"]: each["height"] for each in way}
    assert heights["hover"] > heights["lift"] > heights["grasp"] > 0
    assert way[-1]["along"] == pytest.approx(np.hypot(0.10, 0.05))
    pixel = {each["name"]: each["pixel"] for each in way}
    for name, xy in (("grasp", ACTION.pick_xy), ("place", ACTION.place_xy)):
        assert pixel[name] == pytest.approx(CALIBRATION.base_to_pixel(np.array([xy]))[0])
    home = Proposal(None, {}, None, 0)
    assert plan_head(home, CALIBRATION) == {"way": []}


def test_its_files_name_no_other_host_and_nothing_inline():
    for file in OperatorSession.files.values():
        text = file.read().decode()
        assert not re.search(r"https?://|\bstyle=|\bon\w+=\"|\beval\(|new Function|innerHTML", text)
        named = re.findall(r'(?:src|href)="([^"]+)"|from "\./([^"]+)"', text)
        assert {a or b for a, b in named} <= {*FILES, *OperatorSession.files, "data:,"}
