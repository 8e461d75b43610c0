"""The server as an attacker, a clumsy page and a stopped browser meet it."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import ExitStack
from pathlib import Path

import pytest
from fixtures.page_server import hear, serve_page
from websockets.exceptions import ConnectionClosed, InvalidStatus

from warp_deform.errors import InputError
from warp_deform.page.access import StaticFile
from warp_deform.page.server import MOST_JOBS, MOST_MESSAGES, MOST_TABS, listen
from warp_deform.page.wire import pack


class Counter:
    """A session that counts."""

    files = {"": StaticFile("index.html")}
    verbs = {"add": {"number": int}, "big": {}, "wait": {}, "halt": {}}
    urgent = frozenset({"halt"})

    def __init__(self):
        self.stop = threading.Event()
        self.total, self.done, self.threads = 0, [], set()

    def greet(self):
        self.threads.add(threading.get_ident())
        return [pack("hello"), pack("scene", total=self.total)]

    def do(self, job, post):
        self.threads.add(threading.get_ident())
        if job.do == "add":
            if not -100 < job.values["number"] < 100:
                raise InputError("a number from -99 to 99")
            if job.at not in (-1, len(self.done)):
                raise InputError("somebody was quicker")
            self.total += job.values["number"]
            self.done.append(job.values["number"])
            post(pack("scene", total=self.total, count=len(self.done)))
        elif job.do == "halt":
            post(pack("halted", total=self.total), everyone=False)
        elif job.do == "big":
            post(pack("clip", total=self.total, text="x" * 2**20))
        else:
            self.stop.wait(20)
            post(pack("stopped"), everyone=False)


@pytest.fixture(scope="module")
def server():
    with serve_page(Counter()) as server:
        yield server
    # none where this process ran only tests that ask nothing of it
    assert len(server.session.threads) <= 1


@pytest.fixture
def tab(server):
    with server.tab() as tab:
        hear(tab, "scene")
        yield tab


def say(tab, **job):
    tab.send(json.dumps(job))


def test_files_come_with_a_strict_policy(server):
    base, host = f"/{server.access.token}/", [("Host", server.access.hosts[0])]
    page = server.get(base, host)
    assert page.status == 200 and b"page.js" in page.content
    assert page.getheader("Content-Security-Policy").startswith(
        "default-src 'none'; script-src 'self'"
    )
    assert page.getheader("Referrer-Policy") == "no-referrer"
    assert page.getheader("X-Content-Type-Options") == "nosniff"
    assert page.getheader("Cache-Control") == "no-store"
    script = server.get(base + "page.js", host)
    assert script.status == 200 and script.getheader("Content-Type").startswith("text/javascript")
    assert server.get(base + "../access.py", host).status == 404
    assert server.get(base + "%2e%2e/access.py", host).status == 404
    assert server.get("/", host).status == 403
    assert server.get(base, [("Host", "evil.example")]).status == 403
    assert server.get(base, []).status == 403
    assert server.get(base, [*host, ("Origin", "http://evil.example")]).status == 403
    two = server.get(base, [*host, ("Host", "evil.example")])
    assert two.status in (400, 403) and b"page.js" not in two.content


@pytest.mark.parametrize("origin", [None, "null", "http://evil.example", "http://127.0.0.1:1"])
def test_other_pages_get_no_socket(server, origin):
    with pytest.raises(InvalidStatus) as refused:
        server.tab(origin=origin)
    assert refused.value.response.status_code == 403


def test_a_forwarded_port_is_the_same_page(server):
    """As `ssh -L N:127.0.0.1:N` does it, here from 127.0.0.2; another number is another host."""
    port, base = server.access.port, f"/{server.access.token}/"

    def forward():
        near, _ = relay.accept()
        far = socket.create_connection(("127.0.0.1", port))
        pipes = [threading.Thread(target=pipe, args=two) for two in ((near, far), (far, near))]
        for each in pipes:
            each.start()
        for each in pipes:
            each.join()
        for each in (near, far):
            each.close()

    def pipe(source, sink):
        while data := source.recv(2**16):
            sink.sendall(data)
        sink.shutdown(socket.SHUT_WR)

    with socket.create_server(("127.0.0.2", port)) as relay:
        end = threading.Thread(target=forward)
        end.start()
        with server.tab(sock=socket.create_connection(("127.0.0.2", port))) as tab:
            assert hear(tab, "scene")["total"] == server.session.total
            say(tab, do="add", number=3)
            assert hear(tab, "scene")["total"] == server.session.total
        end.join(10)
        assert not end.is_alive()
    assert server.get(base, [("Host", f"localhost:{port}")]).status == 200
    assert server.get(base, [("Host", f"localhost:{port + 1}")]).status == 403


@pytest.mark.parametrize(
    ("raw", "code"),
    [
        (b"\x00\x01", 1003),
        ("", 1003),
        ("[" * 3000, 1003),
        ('{"do": "add", "number": NaN}', 1003),
        ('{"do": "drop"}', 1003),
        ("x" * 4097, 1009),
        ("x" * 3 * 2**20, 1009),
    ],
)
def test_who_sends_what_no_page_sends_is_closed_and_nobody_else(server, tab, raw, code):
    before = server.session.total
    with server.tab() as wrong, pytest.raises(ConnectionClosed) as closed:
        hear(wrong, "scene")
        wrong.send(raw)
        wrong.recv(timeout=10)
        wrong.recv(timeout=10)
    assert closed.value.rcvd.code == code
    say(tab, do="add", number=0)
    assert hear(tab, "scene")["total"] == before == server.session.total


@pytest.mark.parametrize("number", [10**40, -500, "abc", None, 1.5])
def test_wrong_values_are_told_to_the_one_who_sent_them(server, tab, number):
    before = server.session.total
    say(tab, do="add", number=number)
    assert hear(tab, "note")["text"]
    say(tab, do="add", number=1)
    assert hear(tab)["total"] == before + 1


def test_two_tabs_see_everything_in_one_order(server):
    """Of jobs that both send at once those are done that saw the latest state."""
    done = len(server.session.done)
    with server.tab() as one, server.tab() as other:
        start = hear(one, "scene")["total"]
        hear(other, "scene")
        for number in range(6):
            for tab in (one, other):
                say(tab, do="add", number=number, at=done + number)
        seen = [[hear(tab, "scene") for _ in range(6)] for tab in (one, other)]
    assert [m["total"] for m in seen[0]] == [m["total"] for m in seen[1]]
    assert seen[0][-1]["total"] == server.session.total == start + sum(range(6))
    assert server.session.done[done:] == list(range(6))


def test_a_long_job_is_stopped_and_only_so_many_wait(server, tab):
    say(tab, do="wait")
    before = server.session.total
    for _ in range(MOST_JOBS + 4):
        say(tab, do="add", number=1)
    for _ in range(5):  # one of those that wait is the long one
        assert "try again" in hear(tab, "note")["text"]
    tab.send('{"do":"stop"}')
    assert hear(tab, "stopped")
    totals = [hear(tab, "scene")["total"] for _ in range(MOST_JOBS - 1)]
    assert totals[-1] == server.session.total == before + MOST_JOBS - 1


def test_what_is_urgent_waits_for_nothing_that_waits(server, tab):
    """It waits for the job in hand alone, also where the queue is full or a tab floods it."""
    with server.tab() as other:
        hear(other, "scene")
        say(other, do="wait")
        for _ in range(MOST_JOBS):
            say(other, do="add", number=1)
        assert "try again" in hear(other, "note")["text"]
        before = server.session.total
        for _ in range(5):  # of one tab no second one waits
            say(tab, do="halt")
        tab.send('{"do":"stop"}')
        assert hear(tab, "halted", "scene") == {"kind": "halted", "total": before}
        kinds = [hear(tab, "halted", "scene")["kind"] for _ in range(MOST_JOBS - 1)]
        assert kinds == ["scene"] * (MOST_JOBS - 1)
        say(tab, do="halt")
        assert hear(tab, "halted")["total"] == before + MOST_JOBS - 1


def test_what_is_urgent_and_said_again_while_it_is_done_is_done_again(server, tab, monkeypatch):
    """The first may have answered a question, and the second be meant for what moves now."""
    do, go_on = server.session.do, threading.Event()

    def slowly(job, post):
        do(job, post)
        assert go_on.wait(20)

    monkeypatch.setattr(server.session, "do", slowly)
    say(tab, do="halt")
    hear(tab, "halted")  # it is in hand still
    say(tab, do="halt")
    say(tab, do="add", number="many")
    hear(tab, "note")  # what was said before that has been taken
    go_on.set()
    hear(tab, "halted")


def test_a_tab_that_does_not_read_is_cut_off_and_greeted_anew(server, tab):
    """No other tab waits for it, and no more than so many messages are kept for it."""
    with server.tab(max_queue=1) as deaf:
        took = []
        for _ in range(MOST_MESSAGES + 24):
            began = time.perf_counter()
            say(tab, do="big")
            hear(tab, "clip")
            took.append(time.perf_counter() - began)
        assert max(took) < 5  # it does not wait for anybody's timeout
        with pytest.raises(ConnectionClosed):
            for _ in range(MOST_MESSAGES + 30):
                deaf.recv(timeout=10)
    with server.tab() as again:
        assert hear(again, "scene")["total"] == server.session.total


def test_only_so_many_tabs(server):
    with ExitStack() as tabs:
        for _ in range(MOST_TABS):
            hear(tabs.enter_context(server.tab()), "scene")
        with server.tab() as late, pytest.raises(ConnectionClosed) as closed:
            late.recv(timeout=10)
    assert closed.value.rcvd.code == 1013


def test_a_port_that_is_taken_is_told(server):
    with pytest.raises(InputError, match=f"port {server.access.port} of 127.0.0.1 cannot be used"):
        listen(server.access.port)


DEAF = """
import sys
from websockets.sync.client import connect
with connect(sys.argv[1], origin=sys.argv[2], compression=None, max_size=2**26) as tab:
    print("hears", flush=True)
    for message in tab:
        pass
"""


def test_a_stopped_browser_costs_no_memory(server, tab):
    """A client that is stopped by a signal, while 80 MB are sent: the server keeps few of them."""
    address = server.access.address.replace("http", "ws", 1) + "ws"
    client = subprocess.Popen(
        [sys.executable, "-c", DEAF, address, server.access.origins[0]],
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert client.stdout.readline() == "hears\n"
        for _ in range(8):  # what a first message needs once
            say(tab, do="big")
            hear(tab, "clip")
        client.send_signal(signal.SIGSTOP)
        before, most = resident(), 0
        for _ in range(80):
            say(tab, do="big")
            hear(tab, "clip")
            most = max(most, resident())
        assert most - before < 50 * 2**20
    finally:
        client.kill()
        client.wait()


def resident() -> int:
    """Memory of this process [bytes]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
