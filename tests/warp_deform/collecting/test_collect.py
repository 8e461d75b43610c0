"""Collecting demonstrations: the same files whatever workers, lanes and interruptions."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from warp_deform.collecting import collect as collecting
from warp_deform.collecting.collect import CollectConfig, CollectReport, collect, most_attempts
from warp_deform.collecting.folder import Attempt, Collection
from warp_deform.collecting.video import check_video
from warp_deform.collecting.workers import worker_count
from warp_deform.episodes import EpisodeReader, combine_hashes
from warp_deform.errors import InputError
from warp_deform.planning.demonstrators import demonstrator
from warp_deform.worlds import Worlds
from warp_deform.worlds.loop import SOLVED, play

TASK = "cable-line-notarget"
SEED = 7


def config(out: Path, **changes: object) -> CollectConfig:
    plain = CollectConfig(task=TASK, episodes=4, seed=SEED, out=out, workers=1)
    return replace(plain, **changes)  # type: ignore[arg-type]


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.glob("*.parquet")}


@pytest.fixture(scope="module")
def collected(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, CollectReport]:
    """Four demonstrations, collected by one process at a stretch."""
    out = tmp_path_factory.mktemp("collected")
    return out, collect(config(out))


def test_report_says_what_the_files_say(collected: tuple[Path, CollectReport]) -> None:
    out, report = collected
    infos = EpisodeReader(out).infos()
    assert (report.task, report.episodes, report.successes) == (TASK, 4, len(infos))
    assert report.attempts == infos[-1].seed - SEED + 1
    assert report.success_rate == 4 / report.attempts
    assert report.mean_actions == np.mean([info.actions for info in infos])
    assert report.sim_seconds == pytest.approx(sum(info.sim_seconds for info in infos))
    assert report.state_hash == combine_hashes(info.state_hash for info in infos)
    assert report.physics_ok and report.mean_score == 1.0
    json.dumps(asdict(report), allow_nan=False)


def test_an_episode_holds_everything(collected: tuple[Path, CollectReport]) -> None:
    out, _ = collected
    for episode in EpisodeReader(out):
        info, steps, goal = episode.info, episode.steps, episode.goal
        assert (info.success, info.demonstrator, info.robot) == (True, "scripted", "ur5")
        assert info.config["solver"]["dt"] == pytest.approx(1 / 1200)
        assert info.config["primitive"]["hover"] == 0.30
        assert info.config["cable"]["beads"] == 24
        assert goal is not None and goal.kind == "constructed" and goal.seed == info.seed
        assert [step.success for step in steps] == [False] * info.actions + [True]
        assert all(step.outcome == "placed" and step.action is not None for step in steps[:-1])
        assert (np.diff([step.sim_seconds for step in steps]) > 0).all()
        assert info.state_hash == combine_hashes(step.state_hash for step in steps)
        assert len({step.state_hash for step in steps}) == len(steps)
        for step in steps:
            assert step.color.shape == (320, 160, 3) and step.height.max() > 0.005
            assert step.particle_q.shape == (24, 3) and step.ground_truth.shape == (144,)


@pytest.mark.in_a_row("workers")
def test_workers_do_not_change_a_byte(
    collected: tuple[Path, CollectReport], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(collecting, "SLOTS", 1)  # leave something to the workers
    report = collect(config(tmp_path, workers=2))
    assert report.state_hash == collected[1].state_hash
    assert report.attempts == collected[1].attempts
    assert files(tmp_path) == files(collected[0])


def test_slots_and_order_do_not_change_an_episode(collected: tuple[Path, CollectReport]) -> None:
    reader = EpisodeReader(collected[0])
    worlds = Worlds(TASK, 3, lanes=8)
    seeds = reversed(reader.seeds)
    act = demonstrator("scripted")
    runs = play(worlds, seeds, act=act, look=lambda worlds, slot: worlds.hash(slot))
    by_seed = {run.seed: run for _, run in runs}
    assert sorted(by_seed) == list(reader.seeds)
    for seed, run in by_seed.items():
        assert run.ended == SOLVED
        assert run.rows == [step.state_hash for step in reader.read(seed).steps]


def test_a_killed_run_goes_on(collected: tuple[Path, CollectReport], tmp_path: Path) -> None:
    command = [sys.executable, "-m", "warp_deform", "demo", TASK, "-n", "200", "--seed", str(SEED)]
    command += ["--workers", "1", "--out", str(tmp_path)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        until = time.monotonic() + 120
        while len(files(tmp_path)) < 2:
            assert process.poll() is None and time.monotonic() < until
            time.sleep(0.01)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    before = files(tmp_path)
    assert 2 <= len(before) < 200
    ledger = tmp_path / "attempts.jsonl"
    ledger.write_bytes(ledger.read_bytes() + b'{"seed": 9, "succ')

    assert collect(config(tmp_path)).state_hash == collected[1].state_hash
    assert files(tmp_path) == files(collected[0])
    surplus = files(tmp_path / "surplus") if (tmp_path / "surplus").exists() else {}
    assert before.items() <= {**files(tmp_path), **surplus}.items(), "a complete episode was lost"
    torn = [line for line in ledger.read_text().splitlines() if not line.endswith("}")]
    assert torn == ['{"seed": 9, "succ'], "the torn line stands alone"


def test_growing_and_shrinking_repeat_nothing(tmp_path: Path) -> None:
    def stamps() -> dict[str, int]:
        return {path.name: path.stat().st_mtime_ns for path in tmp_path.rglob("*.parquet")}

    three = collect(config(tmp_path, episodes=3))
    first = stamps()
    assert collect(config(tmp_path, episodes=2)).successes == 2
    assert len(files(tmp_path)) == 2 and stamps() == first
    again = collect(config(tmp_path, episodes=3))
    assert stamps() == first
    assert replace(again, seconds=0.0) == replace(three, seconds=0.0)
    assert not any((tmp_path / "surplus").iterdir())

    lost = sorted(tmp_path.glob("*.parquet"))[0]
    whole = lost.read_bytes()
    lost.unlink()
    assert collect(config(tmp_path, episodes=3)).state_hash == three.state_hash
    assert lost.read_bytes() == whole


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"task": "cable-ring"}, f"task is {TASK} there and cable-ring here"),
        ({"seed": 8}, "seed is 7 there and 8 here"),
        ({"robot": "panda"}, "robot is ur5 there and panda here"),
        ({"demonstrator": "mpc"}, "demonstrator is scripted there and mpc here"),
    ],
)
def test_a_folder_of_another_collection_is_refused(
    collected: tuple[Path, CollectReport], changes: dict[str, object], said: str
) -> None:
    before = files(collected[0])
    with pytest.raises(InputError, match=said):
        collect(config(collected[0], **changes))
    assert files(collected[0]) == before


def test_strange_folders_are_refused(collected: tuple[Path, CollectReport], tmp_path: Path) -> None:
    merged = tmp_path / "merged"
    merged.mkdir()
    for name, data in files(collected[0]).items():
        (merged / name).write_bytes(data)
    with pytest.raises(InputError, match="not collected into it"):
        collect(config(merged))
    (merged / "collection.json").write_text("{")
    with pytest.raises(InputError, match="damaged"):
        collect(config(merged))
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "index.json").write_text("a page's")
    with pytest.raises(InputError, match="no collection"):
        collect(config(foreign))
    assert (foreign / "index.json").read_text() == "a page's"
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="is a file"):
        collect(config(tmp_path / "file"))


def test_the_folder_of_a_video_is_made(tmp_path: Path) -> None:
    check_video(tmp_path / "new" / "film.mp4")
    assert list((tmp_path / "new").iterdir()) == []
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="no video can be written"):
        check_video(tmp_path / "file" / "film.mp4")


def test_two_owners_are_one_too_many(tmp_path: Path) -> None:
    with Collection(tmp_path, {"task": TASK}).owned():
        with pytest.raises(InputError, match="another process is collecting"):
            with Collection(tmp_path, {"task": TASK}).owned():
                pass
    with Collection(tmp_path, {"task": TASK}).owned():
        pass


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"demonstrator": "me"}, "no demonstrator 'me'; there are: scripted, visible, mpc"),
        ({"episodes": 0}, "episodes is 0"),
        ({"seed": -1}, "the seed is -1; it must be 0 to"),
        ({"workers": 0}, "workers is 0"),
        ({"workers": 100_000}, "workers is 100000, more than"),
        ({"robot": "r2d2"}, "ur5, panda"),
        ({"video": Path("film.avi")}, "must end with"),
    ],
)
def test_bad_settings_are_refused(tmp_path: Path, changes: dict[str, object], said: str) -> None:
    with pytest.raises(InputError, match=said):
        collect(config(tmp_path, **changes))
    assert files(tmp_path) == {}


def _attempts(*successes: bool) -> dict[int, Attempt]:
    return {SEED + i: Attempt(SEED + i, success, 1, 0.0, "") for i, success in enumerate(successes)}


def test_a_plan_fills_holes_first_and_ends() -> None:
    four = config(Path("unused"))
    assert collecting._plan(four, {}) == [SEED, SEED + 1, SEED + 2, SEED + 3]
    holes = _attempts(True, False, True, True, True)
    del holes[SEED + 2]
    assert collecting._plan(four, holes)[0] == SEED + 2
    done = _attempts(True, False, True, True, True, True)
    assert collecting._plan(four, done) == []
    assert collecting._kept(four, done) == ([SEED, SEED + 2, SEED + 3, SEED + 4], 5)


def test_a_hopeless_task_is_given_up() -> None:
    four, attempts, rounds = config(Path("unused")), _attempts(), 0
    while todo := collecting._plan(four, attempts):
        attempts |= {seed: Attempt(seed, False, 1, 0.0, "") for seed in todo}
        rounds += 1
    assert len(attempts) == most_attempts(4)
    assert collecting._kept(four, attempts) == ([], most_attempts(4))
    assert rounds < 60


def test_few_episodes_need_no_second_process() -> None:
    assert worker_count(None, 10) == 1
    assert worker_count(3, 1) == 3
    assert worker_count(None, 10**6) >= 1
