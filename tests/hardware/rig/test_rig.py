"""Opening a setup: its files must belong together, and to what stands on the table."""

from __future__ import annotations

import contextlib
import errno
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures.filmed_rig import filmed
from fixtures.franka_episodes import CALIBRATION

from hardware.arm.table_plane import TablePlane
from hardware.episodes.goals import write_picture
from hardware.rig.config import RigConfig
from hardware.rig.rig import open_rig, read_calibration, read_intrinsics, read_table
from warp_deform.errors import InputError


def write_table(setup: Path, table: TablePlane) -> None:
    record = {"schema": 1, "height_m": table.height_m, "slope_x": table.slope_x,
              "slope_y": table.slope_y}  # fmt: skip
    (setup / "table.json").write_text(json.dumps(record))


def test_a_table_touched_off_anew_needs_a_new_calibration(tmp_path: Path) -> None:
    config = filmed(tmp_path)
    with open_rig(config) as rig:  # a calibration alone is enough
        assert rig.robot.limits.table == CALIBRATION.table
    write_table(tmp_path, CALIBRATION.table)
    assert read_table(tmp_path / "table.json") == CALIBRATION.table
    with open_rig(config) as rig:
        assert rig.robot.limits.table == CALIBRATION.table
    write_table(tmp_path, replace(CALIBRATION.table, height_m=CALIBRATION.table.height_m + 1e-3))
    refused = pytest.raises(
        InputError, match=r"table\.json and the calibration hold different tables, .* again$"
    )
    with refused, open_rig(config):
        pass


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"host": "10.0.0.2"}, "robot 'panda 10.0.0.1', not 'panda 10.0.0.2'; give --robot"),
        ({"robot": "fr3"}, "not 'fr3 10.0.0.1'"),
        ({"device": "1"}, "camera 'uvc', not 'uvc 1'; give --camera"),
        ({"camera": "realsense"}, "not 'realsense'"),
        ({"device": "0"}, ""),
        ({"robot": "dry_run", "host": None, "device": "1"}, ""),
        ({"host": "10.0.0.2", "execute": False, "camera": "file"}, "not 'panda 10.0.0.2'"),
        ({"camera": "file"}, ""),
    ],
)
def test_a_calibration_is_of_one_robot_and_one_camera(
    tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    config = RigConfig(robot="panda", host="10.0.0.1", camera="uvc", setup=tmp_path, execute=True)
    replace(CALIBRATION, robot_id=config.robot_id, camera_id=config.camera_id).save(
        tmp_path / "calibration.json"
    )
    with pytest.raises(InputError, match=message) if message else contextlib.nullcontext():
        assert read_calibration(replace(config, **change)).camera_id == "uvc"


def test_a_picture_is_written_whole_or_not_at_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A kill or a full disk in the middle leaves the goal or the empty foam that was there."""
    path = tmp_path / "goal.png"
    write_picture(path, np.zeros((4, 4, 3), np.uint8))
    before = path.read_bytes()

    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(InputError, match="No space left"):
        write_picture(path, np.full((4, 4, 3), 255, np.uint8))
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(("read", "what"), [(read_table, "table"), (read_intrinsics, "lens")])
def test_what_is_not_measured_yet_says_how_to_get_it(read: Any, what: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=rf"no .*{what}\.json: .*franka calibrate {what}` first"):
        read(tmp_path / f"{what}.json")
