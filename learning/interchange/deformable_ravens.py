"""Folders of demonstrations that the original DeformableRavens code recorded, one a task.

`original_recording` says what becomes of an episode.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from warp_deform import __version__
from warp_deform.collecting.workers import Workers, worker_count
from warp_deform.episodes import EpisodeReader, EpisodeWriter, rebuild_index
from warp_deform.errors import InputError
from warp_deform.support.progress import progress_bar
from warp_deform.tasks.registry import TASKS
from warp_deform.tasks.registry import task as find_task

from .conversion import ConversionReport, new_folder, size_of
from .original_recording import PARTS, read_recording

__all__ = ["import_deformable_ravens"]

_NAME = re.compile(r"(\d{6})-([1-9]\d?)\.pkl")
_ORIGINAL_NAMES = {
    "insertion-goal": "block-notarget",
    "cloth-cover": "fabric-cover",
    "cloth-flat": "fabric-flat",
    "cloth-flat-notarget": "fabric-flat-notarget",
    **{name: name for name in TASKS if name.startswith(("cable-", "bag-"))},
}


def import_deformable_ravens(
    source: Path, target: Path, *, task: str | None = None, workers: int | None = None
) -> ConversionReport:
    """Convert one task's folder of the original into a folder of episodes.

    An episode's seed is its number there. An interrupted import goes on when it is called again.

    Args:
        task: our name of the task; None reads it from the folder's name, with which the original's
            begins ("insertion-goal" is block-notarget)
        workers: processes; None takes one per core, but not for a handful of episodes

    Raises:
        InputError: the folder is incomplete, a file is damaged or holds more than data, or
            `target` exists.
    """
    began = time.perf_counter()
    source = Path(source)
    name = _task_of(source) if task is None else find_task(task).name
    recordings = _recordings(source)
    count = worker_count(workers, len(recordings))
    description = {"source": str(source.resolve()), "task": name, "version": __version__}
    with new_folder(target, description=description, resume=True) as folder:
        imported = set(EpisodeReader(folder).seeds) if any(folder.glob("*.parquet")) else set()
        missing = [(seed, steps) for seed, steps in recordings if seed not in imported]
        chunks = [_Chunk(source.resolve(), folder, name, (one,)) for one in missing]
        with (
            progress_bar(name, len(recordings), done=len(imported)) as advance,
            Workers(count) as crew,
        ):
            for _ in crew.run(_import_chunk, chunks):
                advance()
        rebuild_index(folder)
    return ConversionReport(
        format="deformable-ravens",
        out=Path(target),
        task=name,
        episodes=len(recordings),
        steps=sum(steps for _, steps in recordings),
        bytes=size_of(Path(target)),
        seconds=time.perf_counter() - began,
    )


@dataclass(frozen=True)
class _Chunk:
    source: Path
    folder: Path
    task: str
    recordings: tuple[tuple[int, int], ...]


def _import_chunk(chunk: _Chunk) -> Iterator[int]:
    writer = EpisodeWriter(chunk.folder)
    for number, steps in chunk.recordings:
        writer.write(read_recording(chunk.source, number=number, steps=steps, task=chunk.task))
        yield number


def _task_of(source: Path) -> str:
    folder = source.resolve().name
    fitting = [name for name in _ORIGINAL_NAMES if folder.startswith(name)]
    if not fitting:
        raise InputError(
            f"the folder name {folder!r} begins with no task of the original; name it: --task"
        )
    return _ORIGINAL_NAMES[max(fitting, key=len)]


def _recordings(source: Path) -> list[tuple[int, int]]:
    """Number and actions of every episode; all its seven files are there."""
    names: dict[str, set[str]] = {}
    for part in PARTS:
        try:
            names[part] = {path.name for path in (source / part).iterdir()}
        except OSError as error:
            raise InputError(
                f"{source} has no folder {part!r}; give a task's folder of the original, with "
                f"{', '.join(PARTS)}"
            ) from error
    steps_by_number: dict[int, int] = {}
    for name in sorted(set().union(*names.values())):
        match = _NAME.fullmatch(name)
        lacking = [part for part in PARTS if name not in names[part]]
        if match is None:
            part = next(part for part in PARTS if name in names[part])
            raise InputError(f"{source / part / name} is not named EEEEEE-T.pkl; remove it")
        if lacking:
            raise InputError(f"{source / lacking[0] / name} is missing")
        number, steps = int(match[1]), int(match[2])
        if number in steps_by_number:
            raise InputError(f"{source} has two episodes of number {number}")
        steps_by_number[number] = steps
    if not steps_by_number:
        raise InputError(f"{source} holds no episodes")
    return sorted(steps_by_number.items())
