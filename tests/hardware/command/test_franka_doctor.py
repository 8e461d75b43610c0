"""What `warp-deform franka doctor` finds: packages that do not load, the network, priorities."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from hardware.command import doctor
from hardware.command.doctor import Check, examine

LOCAL = "127.0.79.9"


@pytest.fixture
def folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A folder from which modules and programs are taken first."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    return tmp_path


def program(path: Path, *lines: str, code: int = 0) -> None:
    echoes = "\n".join(f"echo '{line}'" for line in lines)
    path.write_text(f"#!/bin/sh\n{echoes}\nexit {code}\n")
    path.chmod(0o755)


def found(name: str, **asked: object) -> Check:
    settings = {"robot": "panda", "host": None, "setup": Path("nowhere"), **asked}
    return next(check for check in examine(**settings) if check.name == name)


def test_a_package_that_does_not_load_is_not_ok(folder: Path) -> None:
    (folder / "pyk4a.py").write_text("raise ImportError('libk4a.so: no such file')\n")
    check = found("pyk4a-bundle")
    assert not check.ok and "does not load: ImportError: libk4a.so" in check.found
    assert "pip install pyk4a-bundle" in check.advice
    (folder / "pyk4a.py").write_text("")
    assert found("pyk4a-bundle").ok


def test_a_package_whose_loading_has_no_end(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder / "pyk4a.py").write_text("import time; time.sleep(60)\n")
    monkeypatch.setattr(doctor, "_IMPORT_LIMIT", 0.3)
    check = doctor._package("pyk4a", "pyk4a-bundle", "depth", "advice", needed=True)
    assert not check.ok and "no end in 0.3 s" in check.found


@pytest.mark.parametrize(
    ("lines", "ok", "said"),
    [
        (
            (
                "20 packets transmitted, 20 received, 0% packet loss, time 3806ms",
                "rtt min/avg/max/mdev = 0.147/0.240/0.502/0.038 ms",
            ),
            True,
            "0.24 ms there and back, 0.50 ms at most",
        ),
        (
            (
                "20 packets transmitted, 20 received, 0% packet loss, time 3806ms",
                "rtt min/avg/max/mdev = 0.147/0.340/4.500/0.900 ms",
            ),
            False,
            "4.50 ms at most",
        ),
        (
            (
                "20 packets transmitted, 19 packets received, 5% packet loss",
                "round-trip min/avg/max = 0.147/0.240/0.502 ms",
            ),
            False,
            "5 % lost",
        ),
        (("20 packets transmitted, 0 received, 100% packet loss, time 19000ms",), False, "100 %"),
        ((), False, "not measured"),
    ],
)
def test_the_network_is_measured(folder: Path, lines: tuple, ok: bool, said: str) -> None:
    program(folder / "ping", *lines, code=0 if ok else 1)
    check = doctor._network(LOCAL)
    assert (check.ok, check.needed) == (ok, False) and said in check.found
    assert check.advice and ("packet" not in "".join(lines) or LOCAL in check.found)


def test_a_host_is_pinged_and_no_other(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder / "ping").write_text(f'#!/bin/sh\necho "$@" >> {folder}/asked\n')
    (folder / "ping").chmod(0o755)
    monkeypatch.setattr(doctor, "_robot", lambda robot, host: Check("robot", True, True, "", ""))
    examine("sim", host=LOCAL, setup=Path("nowhere"))
    examine("sim", host=None, setup=Path("nowhere"))
    (asked,) = (folder / "asked").read_text().splitlines()
    assert asked.endswith(LOCAL) and "-c 20" in asked


def test_real_time_priority(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_run", lambda command, limit: (1, "", "PermissionError: [1]"))
    check = doctor._priority(needed=True)
    assert not check.ok and "refused: PermissionError" in check.found and "rtprio" in check.advice
    assert doctor._priority(needed=False).ok, "only a real arm needs it"
    monkeypatch.setattr(doctor, "_run", lambda command, limit: (0, "", ""))
    assert doctor._priority(needed=True).ok


@pytest.mark.parametrize("name", ["cc", "gcc", "clang"])
def test_every_compiler_that_the_emulator_takes_counts(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, name: str
) -> None:
    program(tmp_path / name)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert doctor._compiler() == Check(
        "C compiler", True, False, str(tmp_path / name), doctor._compiler().advice
    )
