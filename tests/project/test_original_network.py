"""The script that trains the original's network beside `fast`, with a tiny one."""

from __future__ import annotations

import json
import sys
import time
from argparse import Namespace
from dataclasses import replace
from pathlib import Path

import pytest
from fixtures.places import ROOT

sys.path.insert(0, str(ROOT / "benchmarks"))

import original_network as benchmark

from learning.models.transporter import PRESETS


def test_every_snapshot_has_a_row_once_and_training_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tiny = replace(PRESETS["fast"], width=0.125, scale=4, crop=16, fine=False)
    monkeypatch.setattr(benchmark, "NETWORKS", {"original": tiny, "fast": tiny})
    short = replace(benchmark.PLANS["original"], steps=100, shares=(0.5, 1.0), snapshots=1)
    monkeypatch.setattr(benchmark, "PLANS", {**benchmark.PLANS, "original": short})
    out = tmp_path / "rows.jsonl"
    words = ["--tasks", "fabric-flat", "--networks", "original", "--demos", "1", "--episodes", "2",
             "--data", tmp_path / "demos", "--work", tmp_path / "work", "--out", out]  # fmt: skip
    steps = []
    for minutes in ("0.03", "5", "5"):  # broken off, ended, and nothing left to do
        monkeypatch.setattr(sys, "argv", ["x", *map(str, words), "--minutes", minutes])
        benchmark.main()
        rows = [json.loads(line) for line in out.read_text().splitlines()] if out.exists() else []
        steps.append([row["step"] for row in rows])
    assert steps[0] in ([], [50]) and steps[1:] == [[50, 100], [50, 100]]
    first, last = rows
    assert (first["agent"], first["n_episodes"]) == ("transporter", 2)
    assert 0 < first["training_cpu_s"] < last["training_cpu_s"]
    picture = tmp_path / "curve.png"
    benchmark.draw(rows, picture)
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_the_original_is_the_papers_and_begins_as_a_whole_training_would() -> None:
    plan, network = benchmark.PLANS["original"], benchmark.NETWORKS["original"]
    assert network == replace(PRESETS["paper"], n_rotations_train=1)
    assert (plan.steps, plan.lr, plan.decay, plan.warmup, plan.ema) == (20_000, 1e-4, False, 0, 0)
    assert plan.snapshot_steps() == benchmark.ORIGINAL_STEPS


def test_ctrl_c_ends_the_program_and_not_only_the_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def pressed(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(benchmark, "collect", lambda _: None)
    monkeypatch.setattr(benchmark, "train", pressed)
    options = Namespace(data=tmp_path, demos=1, steps=None, work=tmp_path, minutes=1.0)
    with pytest.raises(KeyboardInterrupt):
        benchmark.trained("cable-shape", "fast", options)


def test_an_interrupt_comes_after_cpu_time_and_only_within() -> None:
    began = time.process_time()
    with pytest.raises(benchmark.TimeIsUp), benchmark.interrupted_after(0.1):
        while time.process_time() < began + 30:
            pass
    assert time.process_time() < began + 20
    with benchmark.interrupted_after(0.1):
        pass
    while time.process_time() < began + 0.5:
        pass
