"""The page as a person has it, in headless Chromium.

The session runs in this process, so the tests know where every bead is, and what an action leads
to: the same seed gives the same bits.
"""

from __future__ import annotations

import threading
import time
from dataclasses import replace

import cv2
import numpy as np
import pytest
from fixtures.page_browser import NO_WEBGL, Tab, chromium_path, driver
from fixtures.page_server import serve_page

from warp_deform.collecting.replay import verify
from warp_deform.page.play import PlaySession
from warp_deform.page.sources import EpisodeSource
from warp_deform.page.view import ViewSession
from warp_deform.planning.demonstrators import demonstrator
from warp_deform.worlds import tip_step
from warp_deform.worlds.worlds import Worlds
from warp_deform.xpbd.guards import GuardLimits


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    chromium_path()  # nothing is built where there is none
    session = PlaySession("cable-ring", record=tmp_path_factory.mktemp("kept"))
    with serve_page(session) as server:
        yield server


@pytest.fixture(scope="module")
def launch():
    with driver() as launch:
        yield launch


@pytest.fixture(scope="module")
def browser(launch):
    browser = launch()
    yield browser
    browser.close()


@pytest.fixture
def tab(server, browser):
    server.session.reset(0)
    tab = Tab(browser, server.access.address)
    tab.wait(actions=0, connection="open")
    tab.page.select_option("#speed", "4")
    yield tab
    assert tab.errors == []
    assert all(url.startswith((server.access.address, "data:", "blob:", "ws")) for url in tab.asked)
    tab.page.close()


@pytest.fixture(scope="module")
def alone():
    return Worlds("cable-ring", 1)


def best(session):
    return demonstrator("scripted")(session.worlds, {0: session.run})[0]


def test_a_person_picks_and_places_in_both_views(server, tab, alone):
    session, page = server.session, tab.page
    alone.reset({0: 0})
    assert tab.data("webgl") == "true" and page.title().startswith("cable-ring")
    assert float(tab.data("score")) == alone.score(0)
    shot = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)
    assert len(np.unique(shot[:, :900].reshape(-1, 3), axis=0)) > 100

    page.mouse.click(*tab.on_scene((0.3, -0.7, 0.0)))  # beside the table
    action = best(session)
    q = alone.episodes[0].snapshot.particle_q
    bead = np.linalg.norm(q[:, :2] - action[:2], axis=1).argmin()
    drawn = int(tab.data("drawn"))
    page.mouse.click(*tab.on_scene(q[bead]))
    page.mouse.click(*tab.on_scene((*action[3:5], 0.0)))
    tab.wait(actions=1, playing=False)
    done = session.run.actions[0]
    assert np.abs(done[:5] - action[:5]).max() < 2e-3
    alone.step({0: done})
    assert tab.data("hash") == alone.hash(0)
    assert float(tab.data("score")) == alone.score(0)
    assert int(tab.data("drawn")) > drawn + 4

    second = best(session)
    page.keyboard.press("q")  # 15 degrees
    page.mouse.move(*tab.on_picture(second[:2]))
    page.mouse.down()
    page.mouse.move(*tab.on_picture(second[3:5]), steps=3)
    page.mouse.up()
    tab.wait(actions=2, playing=False)
    done = session.run.actions[1]
    assert np.abs(done[[0, 1, 3, 4]] - second[[0, 1, 3, 4]]).max() < 2 * 0.003125
    assert done[5] == pytest.approx(np.pi / 12) and done[6] == second[6]
    alone.step({0: done})
    assert tab.data("hash") == alone.hash(0)

    page.click("#undo")
    tab.wait(actions=1)
    assert tab.data("hash") != alone.hash(0)


def test_playback_pauses_scrubs_and_changes_no_state(server, tab):
    session, page = server.session, tab.page
    page.select_option("#speed", "0.1")
    page.click("#step")
    tab.wait(playing=True)
    page.click("#pause")
    tab.wait(playing=False)
    stands = tab.data("time")
    assert 0 < float(stands) < float(tab.data("end"))
    page.wait_for_timeout(200)
    assert tab.data("time") == stands
    state, places = session.worlds.hash(0), []
    for share in ("0", "0.6", "1"):
        page.locator("#time").fill(share)
        places.append(tab.data("q"))
    assert len(set(places)) == 3
    tab.wait(actions=1)
    assert tab.data("hash") == state == session.worlds.hash(0)


def test_slow_motion_lasts_longer_and_changes_no_state(server, tab):
    """Half of a motion, at a quarter of the speed and at 4 times."""
    page = tab.page
    page.click("#step")
    tab.wait(actions=1, playing=False)
    state, middle, lasts = tab.data("hash"), float(tab.data("end")) / 2, {}
    for speed in ("4", "0.25"):
        page.select_option("#speed", speed)
        page.locator("#time").fill("0.5")
        begun = time.perf_counter()
        page.keyboard.press("p")
        while float(tab.data("time")) < middle + 0.2:
            assert time.perf_counter() - begun < 60
        lasts[speed] = (time.perf_counter() - begun) / (float(tab.data("time")) - middle)
    assert lasts["0.25"] > 3.5  # wall seconds for one of the motion's: never faster than asked
    assert lasts["0.25"] > 2 * lasts["4"]
    page.locator("#time").fill("1")
    assert tab.data("hash") == state == server.session.worlds.hash(0)


def test_the_arm_moves_while_the_rest_is_computed_and_slow_frames_have_fewer_pixels(
    server, tab, monkeypatch
):
    page, session, go = tab.page, server.session, threading.Event()
    carry = tip_step.carry_and_release
    monkeypatch.setattr(tip_step, "carry_and_release", lambda *given: go.wait(30) and carry(*given))
    chrome = page.context.new_cdp_session(page)
    chrome.send("Emulation.setCPUThrottlingRate", {"rate": 40})
    page.click("#step")
    tab.wait(playing=True, actions=0)
    page.locator("body:not([data-share='1'])").wait_for(state="attached", timeout=30_000)
    chrome.send("Emulation.setCPUThrottlingRate", {"rate": 1})
    approach = float(tab.data("end"))
    tab.wait(playing=True, actions=0, time=f"{approach:.3f}")  # it waits, down at what it takes
    assert session.run.actions == []
    go.set()
    tab.wait(actions=1, playing=False, share=1)
    assert float(tab.data("end")) > approach and tab.data("clips") == "1"
    assert tab.data("hash") == session.worlds.hash(0)


def test_the_keyboard_alone_suffices(server, tab, monkeypatch):
    page, session = tab.page, server.session
    low = session.worlds.task.stages[0]  # a task of two lifts
    stages = (low, replace(low, lift=0.1))
    monkeypatch.setattr(type(session.worlds.task), "stages", stages)
    page.reload()
    page.select_option("#speed", "4")
    tab.wait(actions=0, connection="open")
    page.locator("#lifts button").nth(1).wait_for()
    page.keyboard.press("2")
    for key in ("ArrowUp", "ArrowUp", "ArrowRight", "Shift+ArrowLeft", "Enter"):
        page.keyboard.press(key)
    page.keyboard.press("q")
    for key in ("ArrowDown", "ArrowDown", "ArrowDown", "Space"):
        page.keyboard.press(key)
    tab.wait(actions=1, playing=False)
    done = session.run.actions[0]  # away is -x, right is +y, as the view stands at first
    assert done[:2] == pytest.approx([0.5 - 0.02, 0.008], abs=1e-6)
    assert done[3:] == pytest.approx([0.5 + 0.01, 0.008, np.pi / 12, 0.1], abs=1e-6)
    page.keyboard.press("u")
    tab.wait(actions=0)
    for _ in range(40):  # to a button, by Tab
        page.keyboard.press("Tab")
        if page.locator("#step:focus").count():
            break
    page.keyboard.press("Enter")
    tab.wait(actions=1, playing=False)
    assert session.acted == ["scripted"]


def test_a_guard_that_fires_is_marked_where_it_fired(server, tab, monkeypatch):
    session, page = server.session, tab.page
    solver = session.worlds.solver
    with monkeypatch.context() as patch:
        strict = replace(solver.config, limits=GuardLimits(stretch=1.0001))
        patch.setattr(solver, "config", strict)
        page.click("#step")
        tab.wait(over="the physics broke", playing=False)
    x, y, z = map(float, tab.data("fault").split())
    assert 0.25 < x < 0.75 and abs(y) < 0.5 and -0.01 < z < 0.5
    assert f"near x {x:.3f}" in page.locator("#physics").inner_text()
    marked = page.locator("#top").screenshot()
    page.click("#undo")
    tab.wait(actions=0, fault="")
    assert page.locator("#top").screenshot() != marked
    assert page.locator("#physics").is_hidden()


def test_a_lost_connection_is_taken_up_again_and_a_new_start_is_told(server, browser):
    with serve_page(server.session) as first:
        server.session.reset(0)
        tab = Tab(browser, first.access.address)
        tab.wait(actions=0)
        tab.page.click("#step")
        tab.wait(actions=1, playing=False)
        state = tab.data("hash")
        first.cut()
        tab.wait(connection="lost")
        tab.wait(connection="open", actions=1, hash=state)
        port = first.access.port
    tab.wait(connection="lost")
    assert "not connected" in tab.page.locator("#note").inner_text()
    with serve_page(server.session, port=port):  # with another token
        tab.wait(connection="gone")
        assert "open the one" in tab.page.locator("#note").inner_text()
    tab.page.close()


def test_what_is_kept_can_be_replayed_and_the_second_tab_sees_it(server, browser, tab):
    page, session = tab.page, server.session
    other = Tab(browser, server.access.address)
    other.wait(actions=0)
    other.page.select_option("#speed", "4")
    page.click("#whole")
    other.wait(over="solved", playing=False)
    tab.wait(over="solved", playing=False)
    assert other.data("hash") == tab.data("hash")
    page.reload()
    tab.wait(over="solved", actions=len(session.run.actions))
    page.click("#keep")
    other.wait(seed=1, actions=0)
    tab.wait(seed=1, actions=0)
    other.page.close()
    assert verify(session.kept.folder, workers=1)["mismatches"] == 0


def test_others_look_and_the_table_ranks_them(server, tab):
    page = tab.page
    page.select_option("#who", "scripted")
    page.click("#look")
    page.locator("body[data-peak='none']").wait_for(state="attached", timeout=60_000)
    assert "no heat maps" in page.locator("#sight").inner_text()
    page.click("#versus")
    page.locator("#contest td.solved").wait_for(timeout=60_000)
    cells = page.locator("#contest td").all_inner_texts()
    assert cells[:2] == ["0", "scripted"] and cells[3].endswith("solved")
    assert (tab.data("actions"), server.session.run.actions) == ("0", [])


def test_recorded_episodes_are_watched_and_compared(server, browser):
    """After the test that keeps one."""
    source = EpisodeSource(server.session.kept.folder)
    count = len(source.show(0).actions)
    with serve_page(ViewSession(source)) as viewing:
        tab = Tab(browser, viewing.access.address)
        tab.wait(listed=1, pictures=1)
        tab.page.select_option("#speed", "4")
        tab.page.locator("#list .open").click()
        tab.page.locator("#list .beside").click()
        tab.wait(at0=count, at1=count, same0=True, same1=True, playing0=False, playing1=False)
        assert "bit for bit" in tab.page.locator("#pane1 .says").inner_text()
        tab.page.select_option("#which", "unsolved")
        tab.wait(listed=0)
        assert tab.errors == []
        tab.page.close()


def test_without_webgl_the_picture_from_above_plays(server, launch):
    server.session.reset(0)
    browser = launch(**NO_WEBGL)
    tab = Tab(browser, server.access.address)
    tab.wait(actions=0, webgl=False)
    action = best(server.session)
    for xy in (action[:2], action[3:5]):
        tab.page.mouse.click(*tab.on_picture(xy))
    tab.wait(playing=True)
    seen = set()
    while tab.data("playing") == "true":
        seen.add(tab.data("q"))
    tab.wait(actions=1, playing=False)
    assert len(seen) > 2
    drawn = []
    for share in ("0.4", "0.7"):
        tab.page.locator("#time").fill(share)
        drawn.append(tab.page.locator("#top").screenshot())
    assert drawn[0] != drawn[1]
    assert tab.data("hash") == server.session.worlds.hash(0)
    assert float(tab.data("score")) == server.session.worlds.score(0)
    assert tab.errors == []
    browser.close()
