"""Episodes as a LeRobotDataset v3.0, written with pyarrow alone.

A frame is an observation and the action taken from it; colour is a PNG inside of the frame and
heights are float32 metres, so nothing is lost but digits of the action beyond float32. Frames have
no common rate, because an action takes as long as it takes: their time is their number, at one
frame a second. Names outside of `observation.` reach no LeRobot policy by default; among them is
the simulator's ground truth.

What LeRobot has no place for stands in `meta/warp_deform.parquet`, one row per episode: its whole
metadata and the final observation, after the last action.

Source: the LeRobotDataset v3.0 format of Hugging Face's LeRobot.
"""

from __future__ import annotations

import contextlib
import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from warp_deform import __version__
from warp_deform.episodes import Episode, EpisodeReader
from warp_deform.episodes.corrected import refuse_corrected
from warp_deform.errors import InputError
from warp_deform.support.progress import progress_bar

from .conversion import ConversionReport, new_folder, size_of
from .running_statistics import RunningStatistics

__all__ = ["ACTION_NAMES", "SIDECAR", "export_lerobot"]

ACTION_NAMES = ("pick_x", "pick_y", "pick_yaw", "place_x", "place_y", "place_yaw", "lift")
"""Components of an action [m, rad]."""
SIDECAR = "meta/warp_deform.parquet"
"""Metadata and final observation of every episode."""

_FPS = 1
_FILE_MB = 100
_FILES_A_CHUNK = 1000
_PATH = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_EPISODES_A_BATCH = 100
_IMAGE = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
_MAP = pa.list_(pa.list_(pa.float32()))


@dataclass(frozen=True)
class _Feature:
    """A column: LeRobot's dtype, shape of a frame's value, names of its components or axes."""

    dtype: str
    shape: tuple[int, ...]
    names: tuple[str, ...]

    @property
    def arrow(self) -> pa.DataType:
        if self.dtype == "image":
            return _IMAGE
        number = pa.bool_() if self.dtype == "bool" else getattr(pa, self.dtype)()
        if len(self.shape) == 2:
            return _MAP
        return number if self.shape == (1,) else pa.list_(number, self.shape[0])

    @property
    def hugging_face(self) -> dict[str, Any]:
        """The column's type as the library `datasets` writes it."""
        if self.dtype == "image":
            return {"_type": "Image"}
        if len(self.shape) == 2:
            return {"shape": list(self.shape), "dtype": self.dtype, "_type": "Array2D"}
        value = {"dtype": self.dtype, "_type": "Value"}
        if self.shape == (1,):
            return value
        return {"feature": value, "length": self.shape[0], "_type": "Sequence"}

    def column(self, values: np.ndarray) -> pa.Array:
        """Arrow's column of the frames' values (T, *shape)."""
        if self.dtype == "image":
            return pa.array([{"bytes": _png(image), "path": None} for image in values], _IMAGE)
        flat = pa.array(np.ascontiguousarray(values).ravel())
        if len(self.shape) == 2:
            frames, rows, columns = values.shape
            for count, length in ((frames * rows, columns), (frames, rows)):
                offsets = pa.array(np.arange(count + 1, dtype=np.int32) * length)
                flat = pa.ListArray.from_arrays(offsets, flat)
            return flat
        if self.shape == (1,):
            return flat
        return pa.FixedSizeListArray.from_arrays(flat, self.shape[0])

    def reduced(self, values: np.ndarray) -> np.ndarray:
        """Values (n, ...) over which the statistics go, colours in [0, 1]."""
        if self.dtype == "image":
            return values.reshape(-1, 3) / 255.0
        return values.reshape(-1, 1) if len(self.shape) == 2 else values.reshape(len(values), -1)

    @property
    def statistic_shape(self) -> tuple[int, ...]:
        """LeRobot's shape of a mean: per channel, per component; one for a whole height map."""
        if self.dtype == "image":
            return (3, 1, 1)
        return (1, 1) if len(self.shape) == 2 else self.shape


def export_lerobot(source: Path, target: Path) -> ConversionReport:
    """Write the episodes of folder `source` as a LeRobot dataset in folder `target`.

    Raises:
        InputError: `source` has no episodes, they differ in what they hold, one has no action, or
            `target` exists.
    """
    began = time.perf_counter()
    reader = EpisodeReader(source)
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
        self._robot = ""
        self._features: dict[str, _Feature] = {}
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
        values = _values(episode, start=self.frames, number=self._episodes)
        features = {name: _feature(name, array) for name, array in values.items()}
        robot = episode.info.robot
        if not self._features:
            self._features, self._robot = features, robot
            self._statistics = {
                name: RunningStatistics(feature.statistic_shape)
                for name, feature in features.items()
            }
        if (features, robot) != (self._features, self._robot):
            raise InputError(
                f"the episode of seed {episode.info.seed} differs in images, goal, ground truth or "
                "robot from the first one; convert episodes of one task and robot at a time"
            )
        if episode.info.task not in self.tasks:
            self.tasks.append(episode.info.task)
        values["task_index"][:] = self.tasks.index(episode.info.task)
        own = {
            name: RunningStatistics(feature.statistic_shape) for name, feature in features.items()
        }
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
        last = episode.steps[-1]
        row: dict[str, Any] = {
            "episode_index": self._episodes,
            "tasks": [episode.info.task],
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
                "final_color": {"bytes": _png(last.color), "path": None},
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
            "robot_type": self._robot,
            "total_episodes": self._episodes,
            "total_frames": self.frames,
            "total_tasks": len(self.tasks),
            "chunks_size": _FILES_A_CHUNK,
            "data_files_size_in_mb": _FILE_MB,
            "video_files_size_in_mb": 200,
            "fps": _FPS,
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


_SIDECAR_SCHEMA = pa.schema(
    [
        ("episode_index", pa.int64()),
        ("seed", pa.int64()),
        ("info", pa.string()),
        ("final_color", _IMAGE),
        ("final_height", _MAP),
        ("final_success", pa.bool_()),
        ("final_score", pa.float64()),
    ]
)


def _numbered(file: int) -> str:
    return _PATH.format(chunk_index=file // _FILES_A_CHUNK, file_index=file % _FILES_A_CHUNK)


def _values(episode: Episode, *, start: int, number: int) -> dict[str, np.ndarray]:
    """Every column's values (T, ...) of an episode with T actions, `start` frames before it."""
    count = episode.info.actions
    if count == 0:
        raise InputError(
            f"the episode of seed {episode.info.seed} has no action, and a frame of LeRobot needs "
            "one; convert demonstrations"
        )
    before, after = episode.steps[:-1], episode.steps[1:]
    done = np.arange(count) == count - 1
    scores = np.array([step.score for step in episode.steps])
    values = {
        "observation.images.color": np.stack([step.color for step in before]),
        "observation.height": np.stack([step.height for step in before]),
        "action": np.stack([step.action for step in before if step.action is not None]).astype(
            np.float32
        ),
        "next.reward": np.diff(scores).astype(np.float32),
        "next.done": done,
        "next.success": np.array([step.success for step in after]),
    }
    if episode.goal is not None:
        values["observation.images.goal"] = np.stack([episode.goal.color] * count)
        values["observation.goal_height"] = np.stack([episode.goal.height] * count)
    if episode.steps[0].ground_truth.size:
        values["ground_truth"] = np.stack([step.ground_truth for step in before])
    frames = np.arange(count, dtype=np.int64)
    return values | {
        "timestamp": (frames / _FPS).astype(np.float32),
        "frame_index": frames,
        "episode_index": np.full(count, number, np.int64),
        "index": start + frames,
        "task_index": np.zeros(count, np.int64),
    }


def _feature(name: str, values: np.ndarray) -> _Feature:
    shape = values.shape[1:] or (1,)
    if len(shape) == 3:
        return _Feature("image", shape, ("height", "width", "channels"))
    if len(shape) == 2:
        return _Feature(str(values.dtype), shape, ("height", "width"))
    if name == "action":
        return _Feature(str(values.dtype), shape, ACTION_NAMES)
    plain = (name,) if shape == (1,) else tuple(f"{name}_{i}" for i in range(shape[0]))
    return _Feature(str(values.dtype), shape, plain)


def _png(color: np.ndarray) -> bytes:
    done, data = cv2.imencode(".png", cv2.cvtColor(color, cv2.COLOR_RGB2BGR))
    if not done:
        raise RuntimeError(f"OpenCV cannot encode a picture of shape {color.shape}")
    encoded: bytes = data.tobytes()
    return encoded


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
