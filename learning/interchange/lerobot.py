"""Episodes as a LeRobotDataset v3.0, written with pyarrow alone.

A frame is an observation and the action taken from it; colour is a PNG inside of the frame and
heights are float32 metres, so nothing is lost but digits of the action beyond float32. Frames of
picks and places have no common rate, because an action takes as long as it takes: their time is
their number, at one frame a second. Names outside of `observation.` reach no LeRobot policy by
default; among them is the simulator's ground truth. Control is at its own rate, 20 frames a second.

What LeRobot has no place for stands in `meta/warp_deform.parquet`, one row per episode: its whole
metadata and the final observation, after the last action.

Source: the LeRobotDataset v3.0 format of Hugging Face's LeRobot.
"""

from __future__ import annotations

import contextlib
import json
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from warp_deform import __version__
from warp_deform.episodes import ControlRecord, Episode, EpisodeReader
from warp_deform.episodes.corrected import refuse_corrected
from warp_deform.errors import InputError
from warp_deform.support.progress import progress_bar

from .conversion import ConversionReport, new_folder, size_of
from .lerobot_card import card
from .lerobot_columns import IMAGE, MAP, Feature, as_png, columns, feature_of, kind_of
from .running_statistics import RunningStatistics

__all__ = ["SIDECAR", "export_lerobot"]

SIDECAR = "meta/warp_deform.parquet"
"""Metadata and final observation of every episode."""

_FILE_MB = 100
_FILES_A_CHUNK = 1000
_PATH = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_EPISODES_A_BATCH = 100


def export_lerobot(source: Path, target: Path) -> ConversionReport:
    """Write the episodes of folder `source` as a LeRobot dataset in folder `target`.

    Raises:
        InputError: `source` has no episodes, they differ in what they hold, one has no action, or
            `target` exists.
    """
    began = time.perf_counter()
    reader = EpisodeReader(source, control=True)
    refuse_corrected(reader.infos(), folder=source, advice="this format has no place for labels")
    description = {"source": str(Path(source).resolve()), "to": "lerobot", "version": __version__}
    with new_folder(target, description=description) as folder:
        with progress_bar("lerobot", len(reader)) as advance, _Dataset(folder) as dataset:
            for episode in reader:
                dataset.add(episode)
                advance()
    return ConversionReport(
        format="lerobot",
        out=Path(target),
        task=", ".join(dataset.tasks),
        episodes=len(reader),
        steps=dataset.frames,
        bytes=size_of(Path(target)),
        seconds=time.perf_counter() - began,
    )


class _Dataset:
    """The files of a dataset while they are written."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.tasks: list[str] = []
        self.frames = 0
        self._episodes = 0
        self._kind: tuple[object, ...] = ()
        self._control: ControlRecord | None = None
        self._features: dict[str, Feature] = {}
        self._statistics: dict[str, RunningStatistics] = {}
        self._file = -1
        self._open = contextlib.ExitStack()
        self._data: pq.ParquetWriter | None = None
        self._rows: list[dict[str, Any]] = []
        self._extra: list[dict[str, Any]] = []
        self._meta: pq.ParquetWriter | None = None
        self._sidecar: pq.ParquetWriter | None = None

    def __enter__(self) -> _Dataset:
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        with self._open:
            if kind is None:
                self._flush()
        if kind is None:
            self._finish()

    def add(self, episode: Episode) -> None:
        """Append an episode."""
        control, kind = episode.info.control, kind_of(episode)
        values = columns(episode, start=self.frames, number=self._episodes, fps=_fps(control))
        features = {name: feature_of(name, array, control) for name, array in values.items()}
        quantiles = control is not None
        if not self._features:
            self._features, self._kind, self._control = features, kind, control
            self._statistics = _statistics(features, quantiles)
        if (features, kind) != (self._features, self._kind):
            raise InputError(
                f"the episode of seed {episode.info.seed} differs in images, goal, ground truth, "
                "robot or control from the first one; convert episodes of one task and robot at a "
                "time"
            )
        task = episode.info.task if control is None else control.instruction
        if task not in self.tasks:
            self.tasks.append(task)
        values["task_index"][:] = self.tasks.index(task)
        own = _statistics(features, quantiles)
        for name, feature in features.items():
            for statistics in (own[name], self._statistics[name]):
                statistics.add(feature.reduced(values[name]), frames=episode.info.actions)
        self._write_frames(values)
        self._describe(episode, own)
        self.frames += episode.info.actions
        self._episodes += 1

    def _write_frames(self, values: dict[str, np.ndarray]) -> None:
        if self._data is None or self._size() >= _FILE_MB * 2**20:
            self._next_file()
        assert self._data is not None
        columns = [feature.column(values[name]) for name, feature in self._features.items()]
        self._data.write_table(pa.table(columns, schema=self._schema()))

    def _size(self) -> int:
        return int(self._folder.joinpath("data", _numbered(self._file)).stat().st_size)

    def _next_file(self) -> None:
        if self._data is not None:
            self._data.close()
        self._file += 1
        self._data = self._writer(f"data/{_numbered(self._file)}", self._schema())

    def _writer(self, path: str, schema: pa.Schema) -> pq.ParquetWriter:
        whole = self._folder / path
        whole.parent.mkdir(parents=True, exist_ok=True)
        return self._open.enter_context(pq.ParquetWriter(whole, schema, compression="zstd"))

    def _schema(self) -> pa.Schema:
        described = {name: f.hugging_face for name, f in self._features.items()}
        fields = [pa.field(name, feature.arrow) for name, feature in self._features.items()]
        return pa.schema(
            fields, metadata={"huggingface": json.dumps({"info": {"features": described}})}
        )

    def _describe(self, episode: Episode, statistics: dict[str, RunningStatistics]) -> None:
        """Note an episode's row of the metadata, and its row of the sidecar."""
        last, control = episode.steps[-1], episode.info.control
        row: dict[str, Any] = {
            "episode_index": self._episodes,
            "tasks": [episode.info.task if control is None else control.instruction],
            "length": episode.info.actions,
            "data/chunk_index": self._file // _FILES_A_CHUNK,
            "data/file_index": self._file % _FILES_A_CHUNK,
            "dataset_from_index": self.frames,
            "dataset_to_index": self.frames + episode.info.actions,
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
        }
        for name, statistic in statistics.items():
            row |= {f"stats/{name}/{key}": value for key, value in statistic.as_lists().items()}
        self._rows.append(row)
        self._extra.append(
            {
                "episode_index": self._episodes,
                "seed": episode.info.seed,
                "info": json.dumps(asdict(episode.info), sort_keys=True),
                "final_color": _picture(last.color),
                "final_height": last.height.tolist(),
                "final_success": last.success,
                "final_score": last.score,
            }
        )
        if len(self._rows) == _EPISODES_A_BATCH:
            self._flush()

    def _flush(self) -> None:
        if not self._rows:
            return
        extra = pa.Table.from_pylist(self._extra, schema=_SIDECAR_SCHEMA)
        if self._meta is None or self._sidecar is None:
            table = pa.Table.from_pylist(self._rows)
            self._meta = self._writer(f"meta/episodes/{_numbered(0)}", table.schema)
            self._sidecar = self._writer(SIDECAR, extra.schema)
        self._meta.write_table(pa.Table.from_pylist(self._rows, schema=self._meta.schema))
        self._sidecar.write_table(extra)
        self._rows, self._extra = [], []

    def _finish(self) -> None:
        features = {name: asdict(feature) for name, feature in self._features.items()}
        info = {
            "codebase_version": "v3.0",
            "robot_type": self._kind[0],
            "total_episodes": self._episodes,
            "total_frames": self.frames,
            "total_tasks": len(self.tasks),
            "chunks_size": _FILES_A_CHUNK,
            "data_files_size_in_mb": _FILE_MB,
            "video_files_size_in_mb": 200,
            "fps": _fps(self._control),
            "splits": {"train": f"0:{self._episodes}"},
            "data_path": f"data/{_PATH}",
            "video_path": None,
            "features": features,
        }
        statistics = {name: statistic.as_lists() for name, statistic in self._statistics.items()}
        meta = self._folder / "meta"
        meta.joinpath("info.json").write_text(json.dumps(info, indent=4) + "\n")
        meta.joinpath("stats.json").write_text(json.dumps(statistics, indent=4) + "\n")
        pq.write_table(_task_table(self.tasks), meta / "tasks.parquet")
        if self._control is not None:
            text = card(self._control, features, self.tasks, info)
            self._folder.joinpath("README.md").write_text(text)


_SIDECAR_SCHEMA = pa.schema(
    [
        ("episode_index", pa.int64()),
        ("seed", pa.int64()),
        ("info", pa.string()),
        ("final_color", IMAGE),
        ("final_height", MAP),
        ("final_success", pa.bool_()),
        ("final_score", pa.float64()),
    ]
)


def _fps(control: ControlRecord | None) -> int:
    """Frames a second: 1 of picks and places, which have no duration of their own.

    Raises:
        InputError: the rate of control is no whole number, which LeRobot asks for.
    """
    if control is None:
        return 1
    if control.rate != int(control.rate):
        raise InputError(f"LeRobot counts whole frames a second, and these are at {control.rate}")
    return int(control.rate)


def _statistics(features: dict[str, Feature], quantiles: bool) -> dict[str, RunningStatistics]:
    return {
        name: RunningStatistics(feature.statistic_shape, quantiles=quantiles)
        for name, feature in features.items()
    }


def _picture(color: np.ndarray) -> dict[str, Any] | None:
    return {"bytes": as_png(color), "path": None} if color.size else None


def _numbered(file: int) -> str:
    return _PATH.format(chunk_index=file // _FILES_A_CHUNK, file_index=file % _FILES_A_CHUNK)


def _task_table(tasks: list[str]) -> pa.Table:
    """The tasks as pandas writes a frame of `task_index` whose index is the task's text."""
    columns: list[dict[str, Any]] = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": dtype}
        for name, kind, dtype in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    ]
    columns = [{**column, "metadata": None} for column in columns]
    pandas = {"index_columns": ["task"], "columns": columns, "column_indexes": []}
    table = pa.table(
        {"task_index": pa.array(range(len(tasks)), pa.int64()), "task": pa.array(tasks)}
    )
    return table.replace_schema_metadata({"pandas": json.dumps(pandas)})
