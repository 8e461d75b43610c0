"""The columns of a LeRobotDataset: what of an episode stands in a frame, and of which type."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import pyarrow as pa

from warp_deform.control.numbers import recorded_numbers
from warp_deform.episodes import ControlRecord, Episode
from warp_deform.errors import InputError

__all__ = ["ACTION_NAMES", "IMAGE", "MAP", "Feature", "as_png", "columns", "feature_of", "kind_of"]

ACTION_NAMES = ("pick_x", "pick_y", "pick_yaw", "place_x", "place_y", "place_yaw", "lift")
"""Components of a pick and place [m, rad]."""
STATE_NAMES = ("tip_x", "tip_y", "tip_z", "tip_yaw", "holding")
"""Components of `observation.state` under control [m, rad]."""
IMAGE = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
MAP = pa.list_(pa.list_(pa.float32()))


@dataclass(frozen=True)
class Feature:
    """A column: LeRobot's dtype, shape of a frame's value, names of its components or axes."""

    dtype: str
    shape: tuple[int, ...]
    names: tuple[str, ...]

    @property
    def arrow(self) -> pa.DataType:
        if self.dtype == "image":
            return IMAGE
        number = pa.bool_() if self.dtype == "bool" else getattr(pa, self.dtype)()
        if len(self.shape) == 2:
            return MAP
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
            return pa.array([{"bytes": as_png(image), "path": None} for image in values], IMAGE)
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


def kind_of(episode: Episode) -> tuple[object, ...]:
    """What all episodes of a dataset have in common, beyond their columns.

    Of picks and places the robot; of control also the task and how the tip is led.
    """
    record = episode.info.control
    if record is None:
        return (episode.info.robot,)
    how = (record.names, record.mode, record.rate, record.max_speed, record.max_turn)
    return (episode.info.robot, episode.info.task, *how, record.release)


def columns(episode: Episode, *, start: int, number: int, fps: int) -> dict[str, np.ndarray]:
    """Every column's values (T, ...) of an episode with T actions, `start` frames before it.

    Raises:
        InputError: the episode has no action.
    """
    count, record = episode.info.actions, episode.info.control
    if count == 0:
        raise InputError(
            f"the episode of seed {episode.info.seed} has no action, and a frame of LeRobot needs "
            "one; convert demonstrations"
        )
    values = _picks_and_places(episode) if record is None else _led(episode, record)
    actions = [step.action for step in episode.steps if step.action is not None]
    frames = np.arange(count, dtype=np.int64)
    return values | {
        "action": np.stack(actions).astype(np.float32),
        "next.done": frames == count - 1,
        "next.success": np.array([step.success for step in episode.steps[1:]]),
        "timestamp": (frames / fps).astype(np.float32),
        "frame_index": frames,
        "episode_index": np.full(count, number, np.int64),
        "index": start + frames,
        "task_index": np.zeros(count, np.int64),
    }


def _picks_and_places(episode: Episode) -> dict[str, np.ndarray]:
    before, count = episode.steps[:-1], episode.info.actions
    scores = np.array([step.score for step in episode.steps])
    values = {
        "observation.images.color": np.stack([step.color for step in before]),
        "observation.height": np.stack([step.height for step in before]),
        "next.reward": np.diff(scores).astype(np.float32),
    }
    if episode.goal is not None:
        values["observation.images.goal"] = np.stack([episode.goal.color] * count)
        values["observation.goal_height"] = np.stack([episode.goal.height] * count)
    if episode.steps[0].ground_truth.size:
        values["ground_truth"] = np.stack([step.ground_truth for step in before])
    return values


def _led(episode: Episode, record: ControlRecord) -> dict[str, np.ndarray]:
    """Of control: pictures, or without any what the simulator knows; and what the robot knows."""
    rows = [step.control for step in episode.steps if step.control is not None]
    state = [np.append(row.tip, row.holding) for row in rows[:-1]]
    values = {
        "observation.state": np.stack(state).astype(np.float32),
        "next.reward": np.array([row.reward for row in rows[1:]], np.float32),
    }
    if not record.pictures:
        values["observation.environment_state"] = recorded_numbers(episode)[:-1]
        return values
    values["observation.images.top"] = np.stack([step.color for step in episode.steps[:-1]])
    if episode.goal is not None:
        values["observation.images.goal"] = np.stack([episode.goal.color] * episode.info.actions)
    return values


def feature_of(name: str, values: np.ndarray, record: ControlRecord | None) -> Feature:
    """The type of a column of these values."""
    shape = values.shape[1:] or (1,)
    dtype = str(values.dtype)
    if len(shape) == 3:
        return Feature("image", shape, ("height", "width", "channels"))
    if len(shape) == 2:
        return Feature(dtype, shape, ("height", "width"))
    if name == "action":
        return Feature(dtype, shape, ACTION_NAMES if record is None else record.names)
    if name == "observation.state":
        return Feature(dtype, shape, STATE_NAMES)
    plain = (name,) if shape == (1,) else tuple(f"{name}_{i}" for i in range(shape[0]))
    return Feature(dtype, shape, plain)


def as_png(color: np.ndarray) -> bytes:
    """A picture (H, W, 3) uint8 RGB as the bytes of a PNG."""
    done, data = cv2.imencode(".png", cv2.cvtColor(color, cv2.COLOR_RGB2BGR))
    if not done:
        raise RuntimeError(f"OpenCV cannot encode a picture of shape {color.shape}")
    encoded: bytes = data.tobytes()
    return encoded
