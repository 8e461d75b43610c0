"""Dataset folders: kills, parallel writers, the index, and memory."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from fixtures.episode_samples import (
    assert_same_episode,
    make_episode,
    with_info,
)
from fixtures.places import ROOT, SHARED

from warp_deform.episodes import (
    HEIGHT_UNIT,
    EpisodeReader,
    EpisodeWriter,
    combine_hashes,
    episode_name,
    read_index,
    rebuild_index,
)
from warp_deform.errors import InputError, WarpDeformError

# Half a unit, and the rounding of float32 at 0.65 m.
HEIGHT_TOLERANCE = 0.5 * HEIGHT_UNIT + 3e-8


def test_reader_lists_and_iterates_in_seed_order(tmp_path: Path) -> None:
    for seed in (700, 3, 50_000):
        EpisodeWriter(tmp_path).write(make_episode(seed))
    reader = EpisodeReader(tmp_path)
    assert (len(reader), reader.seeds) == (3, (3, 700, 50_000))
    assert [info.seed for info in reader.infos()] == [3, 700, 50_000]
    assert [episode.info.seed for episode in reader] == [3, 700, 50_000]
    with pytest.raises(InputError, match="no episode of seed 4"):
        reader.read(4)
    with pytest.raises(InputError, match="no row 3"):
        reader.read_step(3, 3)
    with pytest.raises(InputError, match="no row -1"):
        reader.read_step(3, -1)


def test_missing_and_empty_folders_and_wrong_names(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="warp-deform demo"):
        EpisodeReader(tmp_path / "missing")
    with pytest.raises(InputError, match="holds no episodes"):
        EpisodeReader(tmp_path)
    file = tmp_path / "file"
    file.write_text("")
    with pytest.raises(InputError, match="cannot be read as a folder"):
        EpisodeReader(file)
    with pytest.raises(InputError, match="is a file"):
        EpisodeWriter(file)
    path = EpisodeWriter(tmp_path).write(make_episode(5))
    path.rename(tmp_path / episode_name(6))
    with pytest.raises(InputError, match="holds the episode of seed 5"):
        EpisodeReader(tmp_path).read(6)
    (tmp_path / "episode_7.parquet").write_bytes(b"")
    with pytest.raises(InputError, match="rename or move"):
        EpisodeReader(tmp_path)


def test_writer_replaces_only_when_told(tmp_path: Path) -> None:
    EpisodeWriter(tmp_path).write(make_episode())
    other = with_info(make_episode(), robot="panda")
    with pytest.raises(InputError, match="exists"):
        EpisodeWriter(tmp_path).write(other)
    assert EpisodeReader(tmp_path).info(0).robot == "ur5"
    EpisodeWriter(tmp_path, overwrite=True).write(other)
    assert EpisodeReader(tmp_path).info(0).robot == "panda"
    assert os.listdir(tmp_path) == [episode_name(0)]


def test_a_failed_write_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def disk_full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    writer = EpisodeWriter(tmp_path)
    monkeypatch.setattr(os, "fsync", disk_full)
    with pytest.raises(WarpDeformError, match="No space left"):
        writer.write(make_episode())
    assert os.listdir(tmp_path) == []


def run_writer(folder: Path) -> subprocess.Popen[bytes]:
    code = (
        "import sys; from pathlib import Path; from fixtures.episode_samples import make_episode\n"
        "from warp_deform.episodes import EpisodeWriter\n"
        "writer = EpisodeWriter(Path(sys.argv[1]))\n"
        "for seed in range(100_000): writer.write(make_episode(seed, size=(64, 48)))\n"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join((str(SHARED), str(ROOT)))}
    return subprocess.Popen([sys.executable, "-c", code, str(folder)], env=environment)


@pytest.mark.skipif(os.name != "posix", reason="needs SIGKILL")
def test_a_killed_writer_leaves_whole_files_only(tmp_path: Path) -> None:
    for attempt in range(3):
        folder = tmp_path / str(attempt)
        folder.mkdir()
        process = run_writer(folder)
        try:
            limit = time.monotonic() + 60
            while not any(folder.glob("*.parquet")) and time.monotonic() < limit:
                time.sleep(0.005)
            time.sleep(0.037 * attempt)
        finally:
            process.send_signal(signal.SIGKILL)
            process.wait()
        reader = EpisodeReader(folder)
        assert reader.seeds == tuple(range(len(reader)))
        for episode in reader:
            expected = make_episode(episode.info.seed, size=(64, 48))
            assert_same_episode(episode, expected, tolerance=HEIGHT_TOLERANCE)


def test_leftovers_are_ignored_and_removed_when_stale(tmp_path: Path) -> None:
    EpisodeWriter(tmp_path).write(make_episode())
    old, new = (tmp_path / f".{episode_name(1)}.{pid}-abc.tmp" for pid in (1, 2))
    unrelated = tmp_path / ".mine.tmp"
    for path in (old, new, unrelated):
        path.write_bytes(b"half an epis")
    for path in (old, unrelated):
        os.utime(path, (time.time() - 7200,) * 2)
    assert len(EpisodeReader(tmp_path)) == 1
    EpisodeWriter(tmp_path)
    assert not old.exists() and new.exists() and unrelated.exists()


def write_some(folder: Path, seeds: range) -> int:
    """Write the seeds that nobody else has written; return how many that were."""
    writer, written = EpisodeWriter(folder), 0
    for seed in seeds:
        try:
            writer.write(make_episode(seed))
            written += 1
        except InputError:
            pass
    return written


def test_two_processes_write_into_one_folder(tmp_path: Path) -> None:
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        counts = pool.starmap(write_some, [(tmp_path, range(30)), (tmp_path, range(10, 40))])
    assert sum(counts) == 40  # a seed that both try is written by exactly one
    reader = EpisodeReader(tmp_path)
    assert reader.seeds == tuple(range(40))
    for episode in reader:
        expected = make_episode(episode.info.seed)
        assert_same_episode(episode, expected, tolerance=HEIGHT_TOLERANCE)
    assert all(name.startswith("episode_") for name in os.listdir(tmp_path))


def test_index_follows_the_files(tmp_path: Path) -> None:
    for seed in range(3):
        EpisodeWriter(tmp_path).write(make_episode(seed))
    index = rebuild_index(tmp_path)
    assert list(index["episodes"]) == [episode_name(seed) for seed in range(3)]
    assert index["state_hash"] == combine_hashes(
        info.state_hash for info in EpisodeReader(tmp_path).infos()
    )
    first = (tmp_path / "index.json").read_bytes()
    assert rebuild_index(tmp_path) == index == read_index(tmp_path) == json.loads(first)
    assert (tmp_path / "index.json").read_bytes() == first

    (tmp_path / episode_name(1)).unlink()
    assert len(read_index(tmp_path)["episodes"]) == 2
    replaced = with_info(make_episode(2), score=0.25)
    EpisodeWriter(tmp_path, overwrite=True).write(replaced)
    assert read_index(tmp_path)["episodes"][episode_name(2)]["score"] == 0.25
    for nonsense in (b"", b"[]", b"\xff\xfe", b'{"episodes": 3}', b"[" * 100_000):
        (tmp_path / "index.json").write_bytes(nonsense)
        assert len(EpisodeReader(tmp_path)) == 2
        assert len(read_index(tmp_path)["episodes"]) == 2
        assert json.loads((tmp_path / "index.json").read_bytes())["format"] == 1


def resident_bytes() -> int:
    fields = Path("/proc/self/statm").read_text().split()
    return int(fields[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs /proc")
def test_memory_does_not_grow_with_the_dataset(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """200 episodes hold 140 MB when decoded; reading them one by one must keep a few of them."""
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)  # 200 waits for the disk
    episode, writer = make_episode(0, size=(320, 160), actions=1), EpisodeWriter(tmp_path)
    for seed in range(200):
        writer.write(with_info(episode, seed=seed))
    reader = EpisodeReader(tmp_path)
    for seed in reader.seeds[:10]:
        decoded = sum(step.color.nbytes + step.height.nbytes for step in reader.read(seed).steps)
    assert decoded > 700_000
    before = resident_bytes()
    for episode in reader:
        assert len(episode.steps) == 2
    assert resident_bytes() - before < 15_000_000
