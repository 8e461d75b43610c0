"""A dataset folder: one immutable file per episode, and an index that may be lost."""

from __future__ import annotations

import errno
import json
import os
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import InputError, WarpDeformError
from ..support.whole_file import whole_file
from ._provenance import combine_hashes
from ._records import MAX_SEED, Episode, EpisodeInfo, Goal, Step

if TYPE_CHECKING:
    from ._parquet import EpisodeFile

_NAME = re.compile(r"episode_(\d{9})\.parquet")
_STALE_SECONDS = 3600.0  # a writer holds its temporary file for milliseconds
_INDEX = "index.json"
_INDEX_FORMAT = 1
# Answers of filesystems that have no hard links (FAT, some network mounts).
_NO_LINKS = {errno.EPERM, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK}


def episode_name(seed: int) -> str:
    """Return the file name of the episode with this seed, 0 to 999,999,999."""
    if not 0 <= seed <= MAX_SEED:
        raise InputError(f"seed {seed} is outside 0 to {MAX_SEED}")
    return f"episode_{seed:09d}.parquet"


def _open_episode(path: Path) -> EpisodeFile:
    # Imported when used: with OpenCV and pyarrow it takes half a second, which neither
    # `warp-deform list` nor a worker that only builds records should spend.
    from ._parquet import EpisodeFile

    return EpisodeFile(path)


class EpisodeWriter:
    """Adds episodes to a folder, each whole or not at all.

    A file is written under a temporary name, flushed to the disk, then given its own name, so a
    kill loses the episode in flight only. Any number of writers may share a folder.

    Args:
        folder: is made, with its parents, where it is missing.
        overwrite: replace an episode of the same seed instead of refusing.

    Raises:
        InputError: `folder` is something else than a folder, or cannot be written to.
    """

    def __init__(self, folder: Path, *, overwrite: bool = False) -> None:
        self._folder = Path(folder)
        self._overwrite = overwrite
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except (FileExistsError, NotADirectoryError) as error:
            raise InputError(f"{folder} is a file; name a folder for the episodes") from error
        except OSError as error:
            raise InputError(
                f"{folder} cannot be made: {error.strerror}; choose another place"
            ) from error
        if not os.access(self._folder, os.W_OK):
            raise InputError(f"the folder {folder} is not writable; choose another place")
        _remove_stale(self._folder)

    def write(self, episode: Episode) -> Path:
        """Store the episode and return its path.

        Raises:
            InputError: the episode cannot be stored without loss, or its seed is there already.
        """
        from ._parquet import encode

        data = encode(episode)
        path = self._folder / episode_name(episode.info.seed)
        _publish(path, data, overwrite=self._overwrite)
        return path


class EpisodeReader:
    """Reads a folder's episodes in any order with memory for one at a time.

    The folder is listed once, here; files are opened when asked for and checked then. Later files
    are seen by a new reader.

    Args:
        control: whether episodes of control at a fixed rate are read; else they are refused, as
            most programs take picks and places.

    Raises:
        InputError: the folder is missing or has no episodes, or a Parquet file in it is not named
            like an episode; nothing is skipped silently.
    """

    def __init__(self, folder: Path, *, control: bool = False) -> None:
        self._folder = Path(folder)
        self._control = control
        self._seeds = _list_seeds(self._folder)
        if not self._seeds:
            raise InputError(
                f"{folder} holds no episodes; collect some: warp-deform demo TASK -n 10 --out DIR"
            )
        self._known = frozenset(self._seeds)

    @property
    def folder(self) -> Path:
        """The folder that is read."""
        return self._folder

    @property
    def seeds(self) -> tuple[int, ...]:
        """The episodes' seeds in ascending order."""
        return self._seeds

    def __len__(self) -> int:
        return len(self._seeds)

    def __iter__(self) -> Iterator[Episode]:
        """Yield the episodes in seed order, one in memory at a time."""
        return map(self.read, self._seeds)

    def path(self, seed: int) -> Path:
        """Return the path of an episode's file; InputError if there is none."""
        if seed not in self._known:
            raise InputError(
                f"{self._folder} has no episode of seed {seed}; it has {len(self)}, "
                f"from {self._seeds[0]} to {self._seeds[-1]}"
            )
        return self._folder / episode_name(seed)

    def info(self, seed: int) -> EpisodeInfo:
        """Return an episode's metadata; reads the file's footer only."""
        with self._open(seed) as file:
            return file.info

    def infos(self) -> list[EpisodeInfo]:
        """Return every episode's metadata in seed order; reads the files' footers only."""
        return [self.info(seed) for seed in self._seeds]

    def read(self, seed: int) -> Episode:
        """Return a whole episode."""
        with self._open(seed) as file:
            return file.episode()

    def read_step(self, seed: int, t: int) -> Step:
        """Return row t, 0 to the number of actions, of an episode; decodes that row only."""
        with self._open(seed) as file:
            return file.step(t)

    def read_goal(self, seed: int) -> Goal | None:
        """Return an episode's goal, None if its task has none; decodes the first row only."""
        with self._open(seed) as file:
            return file.goal()

    def _open(self, seed: int) -> EpisodeFile:
        path = self.path(seed)
        file = _open_episode(path)
        if file.info.seed != seed:
            file.close()
            raise InputError(f"{path} holds the episode of seed {file.info.seed}; rename it")
        if file.info.control is not None and not self._control:
            file.close()
            raise InputError(
                f"{path} holds control at a fixed rate, where picks and places are needed; "
                "`warp-deform replay` and `convert --to lerobot` take it"
            )
        return file


def rebuild_index(folder: Path) -> dict[str, Any]:
    """Write `index.json` from the files' metadata, atomically, and return what it says.

    The index serves people and other programs; nothing here depends on it. Keys: `format`,
    `state_hash` (of the episodes' hashes in seed order) and `episodes`, which maps a file name to
    its `seal` (the digest of its contents), `bytes` and the main metadata.

    Raises:
        InputError: see `EpisodeReader`.
    """
    reader = EpisodeReader(folder, control=True)
    index = _index(reader)
    _publish(reader.folder / _INDEX, _index_text(index), overwrite=True)
    return index


def read_index(folder: Path) -> dict[str, Any]:
    """Return what the index has to say by the files; one that says something else is mended.

    Raises:
        InputError: see `EpisodeReader`.
    """
    reader = EpisodeReader(folder, control=True)
    index = _index(reader)
    text = _index_text(index)
    try:
        with (reader.folder / _INDEX).open("rb") as file:
            current = file.read(len(text) + 1) == text
    except OSError:
        current = False  # missing
    if not current:
        _publish(reader.folder / _INDEX, text, overwrite=True)
    return index


def _index(reader: EpisodeReader) -> dict[str, Any]:
    """What the files' metadata come to."""
    episodes, hashes = {}, []
    for seed in reader.seeds:
        with reader._open(seed) as file:
            info, seal = file.info, file.seal
        hashes.append(info.state_hash)
        episodes[episode_name(seed)] = {
            "seal": seal,
            "bytes": reader.path(seed).stat().st_size,
            "seed": seed,
            "task": info.task,
            "success": info.success,
            "score": info.score,
            "actions": info.actions,
            "demonstrator": info.demonstrator,
            "robot": info.robot,
            "physics_ok": info.physics_ok,
            "sim_seconds": info.sim_seconds,
            "state_hash": info.state_hash,
        }
    return {
        "format": _INDEX_FORMAT,
        "state_hash": combine_hashes(hashes),
        "episodes": episodes,
    }


def _index_text(index: dict[str, Any]) -> bytes:
    return json.dumps(index, indent=1, sort_keys=True, allow_nan=False).encode() + b"\n"


def _list_seeds(folder: Path) -> tuple[int, ...]:
    try:
        names = os.listdir(folder)
    except OSError as error:
        raise InputError(
            f"{folder} cannot be read as a folder of episodes ({error.strerror}); "
            "give the folder that `warp-deform demo` wrote"
        ) from error
    seeds = []
    for name in names:
        match = _NAME.fullmatch(name)
        if match:
            seeds.append(int(match[1]))
        elif name.endswith(".parquet"):
            raise InputError(
                f"{folder / name} is not named episode_<9 digits>.parquet; rename or move it"
            )
    return tuple(sorted(seeds))


def _publish(path: Path, data: bytes, *, overwrite: bool) -> None:
    """Write `data` under a temporary name beside `path`, then give it its name."""
    refused = f"{path} exists; choose another folder or seed, or write with overwrite=True"
    if not overwrite and path.exists():
        raise InputError(refused)
    try:
        with whole_file(path, os.replace if overwrite else _link) as temporary:
            temporary.write_bytes(data)
    except FileExistsError as error:
        raise InputError(refused) from error
    except OSError as error:
        raise WarpDeformError(
            f"{path} cannot be written: {error.strerror}; what is complete is kept"
        ) from error
    _sync_folder(path.parent)


def _link(temporary: Path, path: Path) -> None:
    """Name a file without replacing another, even one that appears at this moment."""
    try:
        os.link(temporary, path)
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        # No hard links here. Renaming may replace the file of a writer that raced for this seed,
        # which is the same episode.
        temporary.replace(path)


def _sync_folder(folder: Path) -> None:
    if os.name != "posix":  # elsewhere a folder cannot be opened, and renaming is durable
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _remove_stale(folder: Path) -> None:
    """Delete what killed writers left; their files are never read, only in the way."""
    limit = time.time() - _STALE_SECONDS
    for path in folder.glob(".*.tmp"):
        if not path.name.startswith((".episode_", f".{_INDEX}.")):
            continue
        try:
            if path.stat().st_mtime < limit:
                path.unlink()
        except FileNotFoundError:
            pass  # its writer, or another cleaner, was quicker
