"""`warp-deform play` and `view` as commands: what they refuse, where they listen, how they end."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import webbrowser
from pathlib import Path

import pytest
from websockets.sync.client import connect

from warp_deform.command.main import main
from warp_deform.episodes import EpisodeReader
from warp_deform.page.wire import unpack


def refused(capsys, *arguments):
    """The one line that a command says which has to refuse."""
    assert main(list(arguments)) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1 and not captured.out
    return captured.err


def test_bad_input_is_one_line_and_nothing_starts(capsys, monkeypatch, tmp_path):
    assert "no task" in refused(capsys, "play", "cable-rings")
    assert "no folder" in refused(capsys, "view", str(tmp_path / "none"))
    assert "holds no episodes" in refused(capsys, "view", str(tmp_path))
    assert "--port" in refused(capsys, "play", "cable-ring", "--port", "65536")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        assert f"port {port} " in refused(capsys, "play", "cable-ring", "--port", port)

    def none(using=None):
        raise webbrowser.Error("could not locate runnable browser")

    monkeypatch.setattr(webbrowser, "get", none)
    assert "no browser" in refused(capsys, "play", "cable-ring", "--browser")
    monkeypatch.setitem(sys.modules, "websockets.asyncio.server", None)
    assert "'.[page]'" in refused(capsys, "play", "cable-ring")


def listening(pid: int) -> set[str]:
    """Addresses [hexadecimal] on which a process listens."""
    links = [os.readlink(link) for link in Path(f"/proc/{pid}/fd").iterdir() if link.is_symlink()]
    inodes = {link[8:-1] for link in links if link.startswith("socket:[")}
    rows = [
        line.split()
        for name in ("tcp", "tcp6")
        for line in Path(f"/proc/{pid}/net/{name}").read_text().splitlines()[1:]
    ]
    return {row[1].split(":")[0] for row in rows if row[3] == "0A" and row[9] in inodes}


def start(*arguments, **options):
    """The command in a process of its own, and the address that it prints."""
    command = [sys.executable, "-m", "warp_deform", "play", *arguments]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options
    )
    for line in process.stderr:
        if found := re.match(r"open (http://127\.0\.0\.1:\d+/[\w-]+/) ", line):
            return process, found[1]
    raise AssertionError("no address was printed")


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_it_listens_on_loopback_and_ends_with_ctrl_c(tmp_path):
    """A kill loses the running episode alone."""
    temporary = tmp_path / "tmp"
    temporary.mkdir()
    record = tmp_path / "mine"
    arguments = ("block-notarget", "--record", str(record), "--json")
    environment = {**os.environ, "TMPDIR": str(temporary)}
    process, address = start(*arguments, env=environment)
    assert listening(process.pid) == {"0100007F"}
    origin = address.rsplit("/", 2)[0]
    url = address.replace("http", "ws", 1) + "ws"
    with connect(url, origin=origin, max_size=2**24, compression=None) as tab:

        def ask(until, **job):
            tab.send(json.dumps(job))
            while (message := unpack(tab.recv(timeout=60)))["kind"] != until:
                pass
            return message

        tab.recv(timeout=60)
        ask("clip", do="demonstrate", who="scripted", whole=True)
        assert ask("note", do="keep")["text"].endswith("episode_000000000.parquet")
        ask("clip", do="demonstrate", who="scripted", whole=True)
        process.kill()
    process.communicate(timeout=30)
    assert EpisodeReader(record).seeds == (0,)
    assert sorted(path.suffix for path in record.iterdir()) == [".parquet"]

    process, address = start(*arguments, env=environment)
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=30)
    assert process.returncode == 0
    assert json.loads(out) == {"task": "block-notarget", "episodes": 1}
    left = [path.name for path in temporary.iterdir()]
    # a compiler that is killed cannot remove its headers
    assert [name for name in left if not name.startswith("wp_pch_")] == []
