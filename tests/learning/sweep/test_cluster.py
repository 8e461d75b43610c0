"""A sweep on a Ray cluster: two nodes on loopback, one of which is killed in the middle."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fixtures.places import ROOT
from safetensors.numpy import load_file

from learning.sweep import read_sweep, run_sweep
from warp_deform.collecting import cluster
from warp_deform.collecting.workers import Workers
from warp_deform.command.main import main
from warp_deform.errors import InputError, WarpDeformError

HEAD, OTHER = "127.0.0.2", "127.0.0.3"
RUNS = 3
GRID = """
out = "{out}"
tasks = ["block-notarget"]
agents = ["gt-mlp"]
demos = [1]
seeds = [0, 1, 2]
steps = 150
batch = 4
snapshots = 1
validate = 0
[evaluation]
episodes = 2
validation_episodes = 1
"""
WAIT_SECONDS = 120.0


def start(*arguments: str) -> None:
    """A node of one core, as `ray start` starts it on a machine of a cluster."""
    command = [sys.executable, "-m", "ray.scripts.scripts", "start", "--num-cpus=1"]
    quiet = ["--disable-usage-stats", "--object-store-memory=80000000"]
    ports = ["--min-worker-port=0", "--max-worker-port=0"]
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path[1:]]),
        "OMP_NUM_THREADS": "1",
    }
    subprocess.run(
        [*command, *quiet, *ports, *arguments], check=True, capture_output=True, env=environment
    )


def processes(*marks: str) -> list[int]:
    """Running processes whose command lines have all of these words in them."""
    lines = {}
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):  # it has just ended
            lines[int(path.parent.name)] = path.read_bytes().decode(errors="replace")
    return [number for number, line in lines.items() if all(mark in line for mark in marks)]


@pytest.fixture(scope="module")
def folder() -> Iterator[Path]:
    """Where a cluster's sockets are: their paths must be short."""
    path = Path(tempfile.mkdtemp(prefix="ray"))
    yield path
    shutil.rmtree(path, ignore_errors=True)


@pytest.fixture(scope="module")
def address(folder: Path) -> Iterator[str]:
    """A cluster of two nodes, each on a loopback address of its own."""
    with socket.create_server((HEAD, 0)) as free:
        port = free.getsockname()[1]
    try:
        start(
            "--head", f"--node-ip-address={HEAD}", f"--port={port}", f"--temp-dir={folder}",
            "--include-dashboard=false",
        )  # fmt: skip
        start(f"--address={HEAD}:{port}", f"--node-ip-address={OTHER}")
        yield f"{HEAD}:{port}"
    finally:
        for each in processes(str(folder)):
            with contextlib.suppress(ProcessLookupError):
                os.kill(each, signal.SIGKILL)


def grid(root: Path) -> Path:
    path = root / "grid.toml"
    path.write_text(GRID.format(out=root / "out"))
    return path


def timeless(value: Any) -> Any:
    """Results of an evaluation without the seconds that it took."""
    if not isinstance(value, dict):
        return value
    return {key: timeless(each) for key, each in value.items() if not key.endswith("seconds")}


def results(out: Path) -> dict[str, Any]:
    """Demonstrations and weights as bytes, and what evaluations came to."""
    kept: dict[str, Any] = {}
    for path in sorted(out.rglob("*")):
        name = str(path.relative_to(out))
        if path.suffix == ".parquet":
            kept[name] = path.read_bytes()
        if path.suffix == ".safetensors":
            kept[name] = {key: value.tobytes() for key, value in load_file(path).items()}
        if path.name == "eval_info.json":
            kept[name] = timeless(json.loads(path.read_text()))
    return kept


def test_a_killed_node_loses_nothing_and_changes_no_bit(
    tmp_path: Path, folder: Path, address: str
) -> None:
    one, many = tmp_path / "one", tmp_path / "many"
    one.mkdir(), many.mkdir()
    assert run_sweep(read_sweep(grid(one)), workers=1)["failed"] == []
    command = [sys.executable, "-c", "from warp_deform.command.main import main; exit(main())"]
    sweep = subprocess.Popen(
        [*command, "sweep", str(grid(many)), "--ray", address, "--json"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT,
    )  # fmt: skip
    runs = many / "out" / "runs"
    until = time.monotonic() + WAIT_SECONDS
    while len(list(runs.glob("*/run.json"))) < 2:  # one a core: both nodes are at work
        assert sweep.poll() is None and time.monotonic() < until
        time.sleep(0.02)
    assert not list(runs.glob("*/sweep.json"))
    (raylet,) = processes("/raylet/raylet", str(folder), OTHER)
    os.kill(raylet, signal.SIGKILL)
    said, errors = sweep.communicate(timeout=2 * WAIT_SECONDS)
    assert sweep.returncode == 0, errors
    answer = json.loads(said)
    assert (answer["runs"], answer["skipped"], answer["failed"]) == (RUNS, 0, [])
    assert len(list(runs.glob("*/sweep.json"))) == RUNS
    assert results(many / "out") == results(one / "out")
    assert sum(name.endswith("eval_info.json") for name in results(one / "out")) == RUNS


def test_errors_come_back_as_they_are_and_lost_work_is_given_up(
    address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(number: int) -> int:
        if number == 2:
            raise InputError("two is refused")
        return number

    def die(_: int) -> int:
        os._exit(1)

    with cluster.joined(address):  # once: whoever joins starts processes
        with pytest.raises(InputError, match=r"workers is 99, more than 8 for each of \d+ cores"):
            Workers(99, ray=address)
        assert sorted(cluster.unordered(refuse, [0, 1, 3], 2)) == [0, 1, 3]
        with pytest.raises(InputError, match=r"^two is refused$"):
            list(cluster.unordered(refuse, [2, 1], 1))
        monkeypatch.setattr(cluster, "_TRIES", 2)
        with pytest.raises(WarpDeformError, match=r"lost 2 times.*what is complete is kept"):
            list(cluster.unordered(die, [0], 1))


def test_a_cluster_that_does_not_answer_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.create_server((HEAD, 0)) as free:
        port = free.getsockname()[1]
    assert main(["sweep", str(grid(tmp_path)), "--ray", f"{HEAD}:{port}"]) == 2
    assert f"no Ray cluster answers at '{HEAD}:{port}'" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
