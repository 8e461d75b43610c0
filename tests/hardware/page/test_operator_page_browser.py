"""The operator's page as a person has it, in headless Chromium."""

from __future__ import annotations

import numpy as np
import pytest
from fixtures.franka_arm import Arm, episode
from fixtures.franka_episodes import ACTION, CALIBRATION
from fixtures.operator_desk import desk
from fixtures.page_browser import Tab, chromium_path, driver

from hardware.choosers.human import HumanChooser
from hardware.page.session import OperatorSession
from hardware.vision.top_down_view import TopDownView


@pytest.fixture(scope="module")
def browser():
    chromium_path()
    with driver() as launch:
        browser = launch()
        yield browser
        browser.close()


@pytest.fixture
def at():
    with desk() as desk_:
        desk_.operator.begin(CALIBRATION)
        yield desk_


def test_the_arm_moves_by_the_button_that_is_pressed_and_by_nothing_else(at, browser, tmp_path):
    """A closed tab, a page that was loaded anew and keys before the question are no answer."""
    arm = Arm()
    first = Tab(browser, at.server.access.address)
    first.wait(connection="open")
    first.page.keyboard.press("Enter")  # nothing is asked yet
    asking = at.asking(
        lambda: episode(tmp_path, arm, [ACTION] * 3, operator=at.operator, show=at.operator.look)
    )
    first.wait(question=1, which="plan", ready=True)
    first.page.close()
    tab = Tab(browser, at.server.access.address)
    page = tab.page
    tab.wait(question=1, ready=True)
    page.reload()
    tab.wait(question=1, ready=True)
    assert arm.count("grasp") == 0 and asking.waits
    shown = {name: page.locator(f"#{name}").screenshot() for name in ("camera", "above", "side")}
    assert page.locator("#text").inner_text().startswith("action 1: pick (0.450, 0.000)")
    page.keyboard.press("s")
    tab.wait(question=2, ready=True)
    assert arm.count("grasp") == 0
    page.locator("#choices .yes").click()
    tab.wait(question=3, ready=True, looks=1)
    assert arm.count("grasp") == 1
    assert all(len(picture) > 1000 for picture in shown.values())
    page.keyboard.press("q")
    assert asking.answer()[0].outcome == "stopped" and at.halts == []
    at.operator.over("stopped after 1 action")
    tab.wait(over=True, ready=False)
    assert tab.errors == []
    assert all(url.startswith((at.server.access.address, "data:", "blob:")) for url in tab.asked)
    page.close()


def test_stop_is_there_while_nothing_is_asked(at, browser):
    tab = Tab(browser, at.server.access.address)
    tab.wait(connection="open")
    tab.page.locator("#stop").click()
    tab.page.locator("#lines li", has_text="Stop was pressed").wait_for(timeout=20_000)
    assert at.halts == ["halt"]
    tab.page.close()


def test_who_has_no_beats_cannot_answer(at, browser, monkeypatch):
    """The program stands still, or a tunnel does: the buttons wait."""
    asking = at.asking(lambda: at.operator.wait("toss the cable"))
    tab = Tab(browser, at.server.access.address)
    tab.wait(question=1, ready=True)
    monkeypatch.setattr(OperatorSession, "_do_beat", lambda self, job, post: None)
    tab.wait(question=1, ready=False)
    tab.page.keyboard.press("Enter")
    assert tab.page.locator("#choices .yes").is_disabled() and asking.waits
    monkeypatch.undo()
    tab.wait(question=1, ready=True)
    tab.page.keyboard.press("Enter")
    assert asking.answer() is True
    tab.page.close()


def test_a_person_points_by_mouse_and_by_keys(at, browser):
    view = TopDownView()
    chooser = HumanChooser(at.operator.point)
    seen = type("Seen", (), {"view": np.zeros((320, 160, 3), np.uint8), "goal": None,
                             "mask": np.zeros((320, 160), bool)})  # fmt: skip
    tab = Tab(browser, at.server.access.address)
    page = tab.page
    asking = at.asking(lambda: chooser.choose(seen))
    tab.wait(which="point", ready=True)
    box = page.locator("#above").bounding_box()
    for share in ((0.25, 0.5), (0.5, 0.25)):
        page.mouse.click(box["x"] + share[0] * box["width"], box["y"] + share[1] * box["height"])
    action = asking.answer()
    for xy, (x, y) in ((action.pick_xy, (0.25, 0.5)), (action.place_xy, (0.5, 0.25))):
        expected = view.pixel_to_base(np.array([y * 320 - 0.5, x * 160 - 0.5]))
        assert np.abs(np.subtract(xy, expected)).max() < 2 * view.pixel_m

    asking = at.asking(lambda: chooser.choose(seen))
    tab.wait(question=2, which="point", ready=True)
    for key in ("ArrowRight", "Enter", "ArrowDown", "ArrowDown", "Shift+ArrowLeft", "Enter"):
        page.keyboard.press(key)
    action = asking.answer()
    middle = view.pixel_to_base(np.array([159.5, 79.5]))
    assert np.subtract(action.pick_xy, middle) == pytest.approx([8 * view.pixel_m, 0.0])
    assert np.subtract(action.place_xy, middle) == pytest.approx(
        [7 * view.pixel_m, 16 * view.pixel_m]
    )
    assert tab.errors == []
    page.close()
