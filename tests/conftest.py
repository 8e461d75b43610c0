"""What holds for every test, and fixtures that several files use."""

import gc
import os
import shutil
import signal

# Workers share the cores, so a thread each, as do the processes that tests start: torch's threads
# spin while they wait for one another. It is read when torch is imported, so before everything.
os.environ["OMP_NUM_THREADS"] = "1"

import pytest
import warp
from fixtures.places import ROOT, TESTS

# What is imported stays: looking through it for garbage again and again takes seconds.
gc.set_threshold(*gc.get_threshold()[:2], 100)

# Newton's kernels only run forward here; without their adjoints they compile in a third of the time
warp.config.enable_backward = False

# a shell that runs the suite in the background has it ignore Ctrl-C, and so would what tests start
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


SLOW = frozenset((TESTS / "slow.txt").read_text().split())
"""Files that take long, as `benchmarks/test_times.py` found."""


def pytest_addoption(parser):
    parser.addoption("--quick", action="store_true", help="leave out what tests/slow.txt lists")


def pytest_ignore_collect(collection_path, config):
    """True leaves a file out; None leaves the choice to others."""
    if config.getoption("--quick") and collection_path.is_relative_to(ROOT):
        return collection_path.relative_to(ROOT).as_posix() in SLOW or None
    return None


def pytest_collection_modifyitems(items):
    """What is to run in a row comes first: two workers would each make what it shares."""
    marks = (item.get_closest_marker("in_a_row") for item in items)
    names = {item: mark.args[0] for item, mark in zip(items, marks, strict=True) if mark}
    items.sort(key=lambda item: (item not in names, names.get(item)))


def pytest_collection_finish():
    """What was imported until now is left out when somebody looks for garbage, as pytest does."""
    gc.freeze()


def pytest_runtest_setup(item):
    """The emulator compiles the robot's model library when it starts."""
    if item.get_closest_marker("emulator") and shutil.which("cc") is None:
        pytest.skip("the emulator needs a C compiler")


def pytest_runtest_teardown():
    """A thread that moves a robot through libfranka stays a real-time one afterwards.

    A worker that stays one keeps a core from all others, and so does every process that it starts.
    """
    if hasattr(os, "sched_getscheduler") and os.sched_getscheduler(0) != os.SCHED_OTHER:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


@pytest.fixture(scope="module")
def emulator():
    """An emulated Panda before a table, in a process of its own."""
    from fixtures.emulator_worlds import RecordingWorld

    from hardware.emulator import EmulatorProcess

    with EmulatorProcess(world=RecordingWorld, free_host=True) as process:
        yield process


@pytest.fixture(scope="module")
def client(emulator):
    """The vendor's client, connected to it."""
    from fixtures.emulator_client import vendor_client

    with vendor_client(emulator.host) as client:
        yield client


@pytest.fixture
def panda(emulator, client):
    """The vendor's client of an arm at home."""
    from fixtures.emulator_client import reset

    reset(client, emulator)
    return client


@pytest.fixture(scope="module")
def connection(emulator):
    """Our backend, connected to the emulated Panda."""
    from hardware.backends.franka_config import NetworkedConfig
    from hardware.backends.panda import PandaRobot

    with PandaRobot(NetworkedConfig(host=emulator.host)) as robot:
        yield robot


@pytest.fixture
def ready_panda(emulator, connection):
    """Our backend of an arm at home, with nothing between its open fingers."""
    from fixtures.emulator_client import HOME

    emulator.user_stop(False)
    connection.recover()
    emulator.place(HOME)
    emulator.call_world("place_object", width=0.0)
    connection.open_gripper()
    emulator.call_world("take")
    return connection


@pytest.fixture(scope="module")
def narrow_networks():
    """The preset's networks have so few channels that a step takes no time; they learn little."""
    from dataclasses import replace

    from learning.models.transporter import PRESETS

    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(PRESETS, "fast", replace(PRESETS["fast"], width=1 / 16))
        yield


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """The folder of a run that took seconds, see `short_runs`; nobody changes it."""
    from fixtures.short_runs import train_shortly

    return train_shortly(tmp_path_factory.mktemp("trained"))


@pytest.fixture
def run(trained, tmp_path):
    """A copy of it to spoil."""
    from learning.runs.folder import RunFolder

    shutil.copytree(trained, tmp_path / "run")
    return RunFolder(tmp_path / "run")


@pytest.fixture
def forgets_tasks(monkeypatch):
    """Tasks that a test registers, and their environments, are not left to the next."""
    import gymnasium

    from warp_deform.tasks import registry

    monkeypatch.setattr(registry, "_REGISTERED", {})
    ids = set(gymnasium.registry)
    yield
    for name in set(gymnasium.registry) - ids:
        del gymnasium.registry[name]
