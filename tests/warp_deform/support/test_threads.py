"""Calls side by side: all of them once, errors and Ctrl-C surface, nothing hangs."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import threading

import joblib
import pytest

from warp_deform.support.threads import call_side_by_side, default_threads

AFTER_A_FORK = """
import atexit, os, threading
from warp_deform.support.threads import call_side_by_side

def both():
    meet = threading.Barrier(2, timeout=20)  # it takes two threads to come through
    call_side_by_side([meet.wait, meet.wait], 2)

def last():
    done = []
    call_side_by_side([lambda: done.append(1)] * 3, 2)
    print(len(done), flush=True)

atexit.register(last)
both()
child = os.fork()
both()
if child:
    assert os.waitpid(child, 0)[1] == 0
"""


@pytest.mark.parametrize("threads", [1, 2, 3, 9])
def test_every_call_is_made_once(threads: int) -> None:
    made: list[int] = []
    call_side_by_side([lambda k=k: made.append(k) for k in range(7)], threads)
    assert sorted(made) == list(range(7))
    call_side_by_side([], threads)


def test_they_run_at_the_same_time_and_have_ended_together() -> None:
    meet = threading.Barrier(3, timeout=20)
    call_side_by_side([meet.wait] * 6, 3)
    assert meet.n_waiting == 0


@pytest.mark.parametrize("by_caller", [True, False])
def test_an_error_of_any_thread_surfaces_and_ends_the_rest(by_caller: bool) -> None:
    meet, begun = threading.Barrier(2, timeout=20), []

    def call() -> None:
        begun.append(1)
        meet.wait()
        if by_caller == (threading.current_thread() is threading.main_thread()):
            raise ValueError("of one thread")
        broken.wait(20)

    broken = threading.Event()
    hook = threading.Timer(0.1, broken.set)  # the other thread is busy when the error comes
    hook.start()
    with pytest.raises(ValueError, match="of one thread"):
        call_side_by_side([call] * 40, 2)
    assert broken.is_set()
    assert len(begun) == 2
    test_every_call_is_made_once(2)


def test_ctrl_c_ends_the_rest() -> None:
    begun: list[int] = []

    def call() -> None:
        begun.append(1)
        if len(begun) == 3:
            os.kill(os.getpid(), signal.SIGINT)
        threading.Event().wait(0.02)

    with pytest.raises(KeyboardInterrupt):
        call_side_by_side([call] * 400, 2)
    assert len(begun) < 40
    test_every_call_is_made_once(2)


def test_threads_outlive_neither_a_fork_nor_python() -> None:
    run = subprocess.run(
        [sys.executable, "-c", AFTER_A_FORK], capture_output=True, text=True, timeout=60
    )
    assert run.returncode == 0, run.stderr
    assert run.stdout.split() == ["3", "3"]


def test_as_many_as_openmp_and_one_in_a_worker_process(monkeypatch: pytest.MonkeyPatch) -> None:
    for value, threads in (("3", 3), ("2,4", 2), ("none", joblib.cpu_count())):
        monkeypatch.setenv("OMP_NUM_THREADS", value)
        assert default_threads() == threads
    monkeypatch.delenv("OMP_NUM_THREADS")
    assert default_threads() == joblib.cpu_count()
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    # which joblib's processes answer as well
    with multiprocessing.get_context("spawn").Pool(1) as workers:
        assert workers.apply(default_threads) == 1
    assert joblib.Parallel(n_jobs=2)([joblib.delayed(default_threads)()]) == [1]
