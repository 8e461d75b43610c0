"""One episode file: a Parquet file of one row group per row, sealed by digests.

Layout, in bytes: `PAR1`, the row groups one after another, the seal (`WDSEAL01` and the digest of
the rest of the file), the Parquet footer, its length, `PAR1`. The footer's metadata holds every row
group's digest. Parquet readers find data by offsets from the footer and never see the seal.

The digests are checked before the bytes reach the Parquet decoder, so a damaged file costs an error
message: no allocation from a damaged length, no traceback from inside a decoder. They protect
against damage, not against forgery; sizes and types are checked all the same.
"""

from __future__ import annotations

import io
import json
import os
import stat
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ..errors import InputError
from . import _png
from ._control_rows import ControlRow
from ._provenance import HASH_BYTES, digest
from ._records import (
    MAX_SIDE,
    Episode,
    EpisodeInfo,
    Goal,
    Step,
    check_episode,
    check_step,
    goal_targets,
    info_from_json,
    info_to_json,
)

_MAGIC = b"PAR1"
_SEAL_MAGIC = b"WDSEAL01"
_SEAL_BYTES = len(_SEAL_MAGIC) + HASH_BYTES
_INFO_KEY, _LAYOUT_KEY = b"warp_deform", b"warp_deform_layout"
_MAX_FILE_BYTES = 2**30
_MAX_FOOTER_BYTES = 2**26
_MAX_INFO_BYTES = 2**24
# What pyarrow raises for bytes that are not Parquet; names that are not UTF-8 give a ValueError.
_MALFORMED = (pa.ArrowException, OSError, ValueError, IndexError)
_FLOAT_COLUMNS = {"particle_q": 3, "particle_qd": 3, "body_q": 7, "body_qd": 6, "ground_truth": 0}
_NARROW_LIST = pa.list_(pa.field("element", pa.float32(), nullable=False))
_WIDE_LIST = pa.list_(pa.field("element", pa.float64(), nullable=False))
_SCHEMA = pa.schema(
    [
        pa.field("step", pa.int32(), nullable=False),
        pa.field("color", pa.binary(), nullable=False),
        pa.field("height", pa.binary(), nullable=False),
        pa.field("action", _WIDE_LIST),
        pa.field("score", pa.float64(), nullable=False),
        pa.field("success", pa.bool_(), nullable=False),
        pa.field("physics_ok", pa.bool_(), nullable=False),
        pa.field("sim_seconds", pa.float64(), nullable=False),
        pa.field("state_hash", pa.string(), nullable=False),
        pa.field("outcome", pa.string()),
        *(pa.field(name, _NARROW_LIST, nullable=False) for name in _FLOAT_COLUMNS),
        pa.field("goal_color", pa.binary()),
        pa.field("goal_height", pa.binary()),
    ]
)
_CONTROL_SCHEMA = pa.schema(
    [
        *(field.with_nullable(field.name in ("color", "height") or field.nullable)
          for field in _SCHEMA),
        pa.field("tip", _WIDE_LIST, nullable=False),
        pa.field("holding", pa.bool_(), nullable=False),
        pa.field("reward", pa.float64(), nullable=False),
    ]
)  # fmt: skip
"""Of control at a fixed rate: heights are null, and so are pictures that were not asked for."""


def encode(episode: Episode) -> bytes:
    """Return the episode as the bytes of a file; equal episodes give equal bytes.

    Raises:
        InputError: the episode cannot be stored and read back without loss; says what is wrong.
    """
    check_episode(episode)
    info = info_to_json(episode.info, episode.goal)
    sink = io.BytesIO()
    writer = pq.ParquetWriter(
        sink,
        _schema_of(episode.info),
        compression="none",  # the images are compressed already
        use_dictionary=False,
        write_statistics=False,
        store_schema=False,
    )
    groups, start = [], len(_MAGIC)
    for t, step in enumerate(episode.steps):
        writer.write_batch(_step_to_batch(t, step, episode.goal if t == 0 else None))
        end = sink.tell()
        with sink.getbuffer() as written:
            groups.append([start, end - start, digest(written[start:end]).hex()])
        start = end
    height, width = episode.steps[0].color.shape[:2]
    layout = {"height": height, "width": width, "groups": groups}
    writer.add_key_value_metadata({_INFO_KEY: info, _LAYOUT_KEY: json.dumps(layout)})
    writer.close()
    with sink.getbuffer() as written:
        footer = written[start:]
        return b"".join((written[:start], _SEAL_MAGIC, digest(footer), footer))


def _step_to_batch(t: int, step: Step, goal: Goal | None) -> pa.RecordBatch:
    columns = {
        "step": pa.array([t], pa.int32()),
        "color": _color(step.color),
        "height": _height(step.height, what=f"row {t}: height"),
        "action": _floats(step.action, _WIDE_LIST),
        "score": pa.array([step.score], pa.float64()),
        "success": pa.array([bool(step.success)]),
        "physics_ok": pa.array([bool(step.physics_ok)]),
        "sim_seconds": pa.array([step.sim_seconds], pa.float64()),
        "state_hash": pa.array([step.state_hash], pa.string()),
        "outcome": pa.array([step.outcome], pa.string()),
        **{name: _floats(getattr(step, name), _NARROW_LIST) for name in _FLOAT_COLUMNS},
        "goal_color": _color(None if goal is None else goal.color),
        "goal_height": _height(None if goal is None else goal.height, what="goal: height"),
    }
    schema = _SCHEMA
    if step.control is not None:
        schema = _CONTROL_SCHEMA
        columns["tip"] = _floats(step.control.tip, _WIDE_LIST)
        columns["holding"] = pa.array([bool(step.control.holding)])
        columns["reward"] = pa.array([step.control.reward], pa.float64())
    return pa.record_batch([columns[name] for name in schema.names], schema=schema)


def _schema_of(info: EpisodeInfo) -> pa.Schema:
    return _SCHEMA if info.control is None else _CONTROL_SCHEMA


def _color(picture: np.ndarray | None) -> pa.Array:
    """A cell; null for no picture, or one of 0 x 0."""
    data = None if picture is None or not picture.size else _png.color_to_png(picture)
    return pa.array([data], pa.binary())


def _height(picture: np.ndarray | None, *, what: str) -> pa.Array:
    """The same of a height map."""
    data = None if picture is None or not picture.size else _png.height_to_png(picture, what=what)
    return pa.array([data], pa.binary())


def _floats(array: np.ndarray | None, kind: pa.ListType) -> pa.Array:
    """Return a list array of one entry without a detour through Python numbers."""
    if array is None:
        return pa.nulls(1, kind)
    values = pa.array(np.ascontiguousarray(array).ravel())
    return pa.ListArray.from_arrays(pa.array([0, len(values)], pa.int32()), values, type=kind)


class EpisodeFile:
    """An open episode file; reads and verifies what is asked for and no more.

    Raises:
        InputError: the file is damaged, foreign or of another version; one line names it.
    """

    info: EpisodeInfo
    seal: str
    """Digest of the footer and, through it, of the whole file: 32 hexadecimal digits."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = _open(path)
        try:
            self._read_footer()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> EpisodeFile:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def episode(self) -> Episode:
        """Return the whole episode."""
        batches = [self._batch(t) for t in range(len(self._groups))]
        steps = tuple(self._step(t, batch) for t, batch in enumerate(batches))
        return Episode(info=self.info, steps=steps, goal=self._goal(batches[0]))

    def step(self, t: int) -> Step:
        """Return row t, 0 to the number of actions; reads that row only."""
        if not 0 <= t < len(self._groups):
            raise InputError(
                f"{self._path} has no row {t}; its rows are 0 to {len(self._groups) - 1}"
            )
        return self._step(t, self._batch(t))

    def goal(self) -> Goal | None:
        """Return the goal, None where the task has none; reads the first row only."""
        return None if self.info.goal is None else self._goal(self._batch(0))

    def _fail(self, why: str) -> InputError:
        return InputError(f"{self._path} cannot be read as an episode: {why}")

    def _read(self, offset: int, length: int) -> bytes:
        try:
            self._file.seek(offset)
            data = self._file.read(length)
        except OSError as error:
            raise self._fail(error.strerror or "it cannot be read") from error
        if len(data) != length:
            raise self._fail("it became shorter while it was read")
        return data

    def _read_footer(self) -> None:
        self._size = os.fstat(self._file.fileno()).st_size
        foreign = "it is damaged, or warp-deform did not write it; delete it and collect it again"
        if self._size < 2 * len(_MAGIC) + 4 + _SEAL_BYTES:
            raise self._fail(foreign)
        if self._size > _MAX_FILE_BYTES:
            raise self._fail(f"it has {self._size} bytes, more than {_MAX_FILE_BYTES}")
        length = 8 + int.from_bytes(self._read(self._size - 8, 4), "little")
        self._end = self._size - length - _SEAL_BYTES
        if length > _MAX_FOOTER_BYTES or self._end < len(_MAGIC):
            raise self._fail(foreign)
        seal_and_footer = self._read(self._end, _SEAL_BYTES + length)
        self._footer = seal_and_footer[_SEAL_BYTES:]
        self.seal = digest(self._footer).hex()
        sealed = seal_and_footer[:_SEAL_BYTES] == _SEAL_MAGIC + bytes.fromhex(self.seal)
        if not sealed or self._footer[-4:] != _MAGIC or self._read(0, 4) != _MAGIC:
            raise self._fail(foreign)
        try:
            # The footer can be parsed alone: its place in the file is counted from the end.
            source = pa.BufferReader(_MAGIC + self._footer)
            self._metadata = pq.ParquetFile(source).metadata
            entries = self._metadata.metadata or {}
            schema = self._metadata.schema.to_arrow_schema()
        except _MALFORMED as error:
            raise self._fail(f"its footer is malformed ({type(error).__name__})") from error
        if len(entries.get(_INFO_KEY, b"")) > _MAX_INFO_BYTES:
            raise self._fail(f"its metadata has more than {_MAX_INFO_BYTES} bytes")
        try:
            self.info = info_from_json(entries.get(_INFO_KEY, b""))
        except InputError as error:
            raise self._fail(str(error)) from error
        self._control, self._schema = self.info.control, _schema_of(self.info)
        if not schema.equals(self._schema):
            raise self._fail("its columns are not those of an episode")
        self._read_layout(entries.get(_LAYOUT_KEY, b""))

    def _read_layout(self, text: bytes) -> None:
        try:
            layout = json.loads(text)
            self._image_size = (int(layout["height"]), int(layout["width"]))
            self._groups = [(int(a), int(n), bytes.fromhex(d)) for a, n, d in layout["groups"]]
        except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
            raise self._fail("its layout record is malformed") from error
        least = 0 if self._control is not None and not self._control.pictures else 1
        if not all(least <= side <= MAX_SIDE for side in self._image_size):
            raise self._fail(f"its images have {self._image_size} pixels")
        ends = [len(_MAGIC), *(start + length for start, length, _ in self._groups)]
        contiguous = [start for start, _, _ in self._groups] + [self._end] == ends
        rows = self.info.actions + 1
        counts = {rows, len(self._groups), self._metadata.num_row_groups, self._metadata.num_rows}
        if not contiguous or len(counts) != 1 or any(n <= 0 for _, n, _ in self._groups):
            raise self._fail("its row groups do not fill the file, one a row")

    def _batch(self, t: int) -> pa.RecordBatch:
        """Verify and decode row group t."""
        start, length, expected = self._groups[t]
        data = self._read(start, length)
        if digest(data) != expected:
            raise self._fail(f"row {t} is damaged; delete the file and collect it again")
        # Offsets in the footer count from the file's start. The pages that stay zero are never
        # touched and take no memory.
        image = np.zeros(self._size, np.uint8)
        image[start : start + length] = np.frombuffer(data, np.uint8)
        image[self._size - len(self._footer) :] = np.frombuffer(self._footer, np.uint8)
        try:
            source = pa.BufferReader(pa.py_buffer(image))
            table = pq.ParquetFile(source, metadata=self._metadata).read_row_group(
                t, use_threads=False
            )
            batch = table.combine_chunks().to_batches()[0]
            batch.validate(full=True)
        except _MALFORMED as error:
            raise self._fail(f"row {t} is malformed ({type(error).__name__})") from error
        if batch.num_rows != 1 or not batch.schema.equals(self._schema):
            raise self._fail(f"row {t} is malformed")
        return batch

    def _step(self, t: int, batch: pa.RecordBatch) -> Step:
        what, control = f"row {t}", self._control
        color, height = batch["color"][0].as_py(), batch["height"][0].as_py()
        try:
            if batch["step"][0].as_py() != t:
                raise InputError(f"{what} says that it is row {batch['step'][0].as_py()}")
            step = Step(
                color=self._decoded_color(color, what=f"{what}: color"),
                height=self._decoded_height(height, what=f"{what}: height"),
                action=_array(batch, "action", columns=0),
                **{
                    name: batch[name][0].as_py()
                    for name in (
                        "score",
                        "success",
                        "physics_ok",
                        "sim_seconds",
                        "state_hash",
                        "outcome",
                    )
                },
                **{name: _array(batch, name, columns=n) for name, n in _FLOAT_COLUMNS.items()},
                control=None if control is None else _control_row(batch),
            )
            last = t == self.info.actions
            check_step(step, t=t, size=self._image_size, last=last, control=control)
        except InputError as error:
            raise self._fail(str(error)) from error
        return step

    def _goal(self, batch: pa.RecordBatch) -> Goal | None:
        record, control = self.info.goal, self._control
        color, height = batch["goal_color"][0].as_py(), batch["goal_height"][0].as_py()
        if record is None and color is None and height is None:
            return None
        seen = control is None or control.pictures
        if record is None or (color is None) == seen or (height is None) != (control is not None):
            raise self._fail("its goal is not whole")
        try:
            return Goal(
                color=self._decoded_color(color, what="goal: color"),
                height=self._decoded_height(height, what="goal: height"),
                targets=goal_targets(record),
                kind=record["kind"],
                seed=record["seed"],
            )
        except InputError as error:
            raise self._fail(str(error)) from error

    def _decoded_color(self, data: bytes | None, *, what: str) -> np.ndarray:
        """A picture; of 0 x 0 where there are none."""
        if data is None:  # the row's check says whether it may be missing
            return np.zeros((0, 0, 3), np.uint8)
        return _png.png_to_color(data, size=self._image_size, what=what)

    def _decoded_height(self, data: bytes | None, *, what: str) -> np.ndarray:
        """A height map; of 0 x 0 in control at a fixed rate, which has none."""
        if data is None:
            return np.zeros((0, 0), np.float32)
        return _png.png_to_height(data, size=self._image_size, what=what)


def _control_row(batch: pa.RecordBatch) -> ControlRow:
    holding, reward = batch["holding"][0].as_py(), batch["reward"][0].as_py()
    return ControlRow(_array(batch, "tip", columns=0), holding, reward)


def _array(batch: pa.RecordBatch, name: str, *, columns: int) -> Any:
    """Return a list column's only entry as an array of its own memory, (n, columns) or (n,)."""
    column = batch[name]
    if column.null_count:
        return None
    values = column.flatten().to_numpy(zero_copy_only=False).copy()
    if columns and len(values) % columns:
        raise InputError(f"{name} has {len(values)} numbers, not a multiple of {columns}")
    return values.reshape(-1, columns) if columns else values


def _open(path: Path) -> BinaryIO:
    """Open a regular file; a pipe or device would block for ever."""
    flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    try:
        descriptor = os.open(path, flags)
    except OSError as error:
        raise InputError(f"{path} cannot be opened: {error.strerror}") from error
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise InputError(f"{path} is no regular file; an episode is a Parquet file")
    return os.fdopen(descriptor, "rb")
