"""What a person measured one by one survives stops, failures and refused results."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from fixtures.blind_camera import BlindCamera
from fixtures.board_photographs import BOARD, INTRINSICS, TABLE, projected, rotation, transform
from fixtures.guided_robot import BASE_T_BOARD, TCP_T_CAMERA, GuidedRobot, setup
from fixtures.safety_spy import HOME, SpyRobot

from hardware.arm.limits import SafetyLimits
from hardware.arm.safe_robot import SafeRobot
from hardware.calibration.calibration import Calibration
from hardware.calibration.charuco import BoardSpec, Corners
from hardware.calibration.poor_fit import PoorFit
from hardware.cameras.camera import CameraError
from hardware.choosers.human import TerminalOperator
from hardware.measuring.measurement_file import MeasurementFile, gather
from hardware.measuring.with_board import measure_hand_eye, measure_lens
from hardware.rig.config import RigConfig
from hardware.rig.rig import read_intrinsics
from hardware.support.json_file import write_json
from warp_deform.errors import InputError

VIEWS = 10
AGREES = TerminalOperator(lambda _: "")

# Gathering.


def numbers(path: Path) -> MeasurementFile[int]:
    return MeasurementFile(
        path,
        "number",
        read=lambda path: json.loads(path.read_text())["numbers"],
        write=lambda path, items: write_json(path, {"numbers": items}),
    )


def test_the_worst_is_taken_again_and_the_old_one_kept_until_then(tmp_path: Path) -> None:
    measured = numbers(tmp_path / "n.json")
    taken: list[int] = []

    def take(index: int) -> int:
        taken.append(index)
        if len(taken) == 4:
            raise InputError("stopped")
        return -1 if len(taken) == 2 else 10 * index

    def fit(items: list[int]) -> int:
        if -1 in items:
            raise PoorFit("one is off", worst=items.index(-1))
        return sum(items)

    def run(measured: MeasurementFile[int]) -> int:
        with measured.guarded():
            return gather(measured, wanted=3, take=take, fit=fit, operator=AGREES)

    with pytest.raises(InputError, match=r"stopped; 3 numbers are kept in .*n\.json: the same"):
        run(measured)
    assert taken == [0, 1, 2, 1] and numbers(measured.path).items == [0, -1, 20]
    assert run(numbers(measured.path)) == 30 and taken == [0, 1, 2, 1, 1]
    assert numbers(measured.path).items == [0, 10, 20]
    measured.remove()
    assert not measured.path.exists()


def test_a_result_that_blames_none_gets_one_more(tmp_path: Path) -> None:
    said: list[str] = []

    def answer(text: str) -> str:
        said.append(text)
        return ""

    def fit(items: list[int]) -> int:
        if len(items) < 5:
            raise InputError("all alike")
        return len(items)

    measured = numbers(tmp_path / "n.json")
    result = gather(
        measured, wanted=3, take=lambda i: i, fit=fit, operator=TerminalOperator(answer)
    )
    assert result == 5 and measured.items == [0, 1, 2, 3, 4]
    assert [text.split("\n")[0] for text in said] == ["all alike", "all alike"]


def test_the_same_one_is_not_taken_again_for_ever(tmp_path: Path) -> None:
    taken: list[int] = []

    def take(index: int) -> int:
        taken.append(index)
        return index

    def fit(items: list[int]) -> int:
        if len(items) < 6:
            raise PoorFit("number 2 is off", worst=1)
        return len(items)

    measured = numbers(tmp_path / "n.json")
    assert gather(measured, wanted=4, take=take, fit=fit, operator=AGREES) == 6
    assert taken == [0, 1, 2, 3, 1, 4, 1, 5]


def test_nothing_is_named_where_nothing_was_kept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    measured = numbers(tmp_path / "n.json")
    with pytest.raises(InputError, match="no; nothing was written"), measured.guarded():
        raise InputError("no")
    with pytest.raises(CameraError, match=r"^gone$"), measured.guarded():
        raise CameraError("gone")
    assert capsys.readouterr().err == ""


# The camera on the hand.


class Bench:
    """An arm, a camera on it and a board that is pushed while some views are taken."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *, pushed: tuple[int, ...] = ()) -> None:
        self.rng = np.random.default_rng(0)
        self.robot = GuidedRobot()
        self.pushed = pushed
        self.seen = 0
        self.asked: list[str] = []
        self.fail: Callable[[str], str | None] = lambda text: None
        monkeypatch.setattr("hardware.measuring.with_board.find_corners", self.corners)

    def corners(self, rgb: np.ndarray, board: BoardSpec) -> Corners:
        """The corners of the board, which is printed with squares of `BOARD`."""
        self.seen += 1
        T = BASE_T_BOARD.copy()
        T[0, 3] += 0.03 * (self.seen in self.pushed)
        seen = np.linalg.inv(self.robot.state().base_T_tcp @ TCP_T_CAMERA) @ T
        pixels = projected(BOARD.corners_m, seen)
        noise = self.rng.normal(0.0, 0.15, (len(pixels), 2))
        return Corners(np.arange(len(pixels)), pixels + noise)

    def answer(self, text: str) -> str:
        self.asked.append(text.split("\n")[0])
        said = self.fail(text)
        if said is None and text.startswith("view"):
            self.robot.guide(self.rng)
        elif "release" in text:
            self.robot.q = HOME + 0.02  # from where the arm may go home
        assert len(self.asked) < 30, self.asked[-1]
        return said or ""

    def measure(self, folder: Path, *, board: BoardSpec = BOARD) -> dict[str, object]:
        self.asked.clear()
        return measure_hand_eye(
            setup(folder),
            board,
            views=VIEWS,
            camera=BlindCamera(),
            robot=SafeRobot(self.robot, SafetyLimits(table=TABLE)),
            operator=TerminalOperator(self.answer),
        )

    @property
    def views(self) -> list[str]:
        """Which views were asked for."""
        return [text.split(":")[0] for text in self.asked if text.startswith("view")]


def found_well(folder: Path) -> bool:
    calibration = Calibration.load(folder / "calibration.json")
    T = np.array(calibration.details["tcp_T_camera"])
    gone = not (folder / "views.json").exists()
    return bool(np.linalg.norm(T[:3, 3] - TCP_T_CAMERA[:3, 3]) < 2e-3) and gone


def test_a_refused_hand_eye_takes_its_worst_view_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Bench(monkeypatch, pushed=(4,))
    bench.measure(tmp_path)
    assert bench.views == [f"view {n} of 10" for n in [*range(1, 11), 4]]
    assert "refused; take picture 4 again" in bench.asked[VIEWS]
    assert bench.robot.log == ["recover", "move_joints", "close"] and found_well(tmp_path)


def test_a_refused_hand_eye_keeps_its_views_and_goes_on_from_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Bench(monkeypatch, pushed=(4,))
    bench.fail = lambda text: "q" if "refused" in text else None
    with pytest.raises(InputError, match=r"take picture 4 again .*10 views are kept in .*\.json"):
        bench.measure(tmp_path)
    assert not (tmp_path / "calibration.json").exists() and not bench.robot.joints
    bench.fail = lambda text: None
    bench.measure(tmp_path)
    assert "10 views are kept" in bench.asked[0] and bench.views == ["view 4 of 10"]
    assert found_well(tmp_path)


@pytest.mark.parametrize("failure", [KeyboardInterrupt(), CameraError("no picture"), None])
def test_an_interrupted_hand_eye_goes_on(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    failure: BaseException | None,
) -> None:
    bench = Bench(monkeypatch)

    def fail(text: str) -> str | None:
        if not text.startswith("view 6"):
            return None
        if failure is None:
            return "q"
        raise failure

    bench.fail = fail
    with pytest.raises(InputError if failure is None else type(failure)) as caught:
        bench.measure(tmp_path)
    said = str(caught.value) if failure is None else capsys.readouterr().err
    assert "5 views are kept in" in said and "views.json" in said
    bench.fail = lambda text: None
    bench.measure(tmp_path)
    assert bench.views == [f"view {n} of 10" for n in range(6, 11)] and found_well(tmp_path)


def test_a_way_home_that_is_not_taken_costs_no_view(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Bench(monkeypatch)
    bench.fail = lambda text: "q" if "release" in text else None
    with pytest.raises(InputError, match="10 views are kept"):
        bench.measure(tmp_path)
    bench.fail = lambda text: None
    bench.measure(tmp_path)
    assert bench.views == [] and found_well(tmp_path)


def test_views_outlive_a_wrong_size_of_the_squares(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Bench(monkeypatch)
    bench.fail = lambda text: "q" if "refused" in text else None
    with pytest.raises(InputError, match="10 views are kept"):
        bench.measure(tmp_path, board=BoardSpec(square_m=0.030, marker_m=0.02))
    bench.measure(tmp_path)
    assert bench.views == [] and found_well(tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"robot_id": "panda 10.0.0.9"}, "robot_id panda 10.0.0.9, not dry_run"),
        ({"camera_id": "uvc 3"}, "camera_id uvc 3"),
        ({"size": [640, 480]}, r"size \[640, 480\], not \[1280, 720\]"),
        ({"board": [5, 4]}, "board"),
        ({"schema": 2}, "schema version 2"),
        ({"views": 3}, "views is 3"),
        ({"views": [3]}, "view 1 of .*base_T_tcp"),
        ({"views": [{"ids": [99, 1, 2, 3]}]}, "view 1 of .*different corners"),
        ({"views": [{"ids": [1, 1, 2, 3]}]}, "view 1 of .*different corners"),
        ({"views": [{"base_T_tcp": (2.0 * np.eye(4)).tolist()}]}, "view 1 of .*no pose"),
        ({"views": [{"pixels": [[1.0, None]] * 4}]}, "view 1 of .*pixels"),
    ],
    ids=str,
)
def test_kept_views_of_another_setup_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: dict, message: str
) -> None:
    view = {
        "base_T_tcp": np.eye(4).tolist(),
        "ids": [0, 1, 2, 3],
        "pixels": [[10.0, 10.0], [20.0, 10.0], [10.0, 20.0], [20.0, 20.0]],
    }
    record = {
        "schema": 1, "robot_id": "dry_run", "camera_id": "realsense", "size": [1280, 720],
        "board": [7, 5], "views": [view], **change,
    }  # fmt: skip
    if isinstance(record["views"], list):
        record["views"] = [{**view, **v} if isinstance(v, dict) else v for v in record["views"]]
    path = tmp_path / "views.json"
    path.write_text(json.dumps(record))
    before = path.read_bytes()
    bench = Bench(monkeypatch)
    with pytest.raises(InputError, match=message) as caught:
        bench.measure(tmp_path)
    assert "\n" not in str(caught.value) and "views.json" in str(caught.value)
    assert bench.asked == [] and path.read_bytes() == before
    assert isinstance(bench.robot, SpyRobot) and not bench.robot.joints


# The lens.


class Desk:
    """A video device and a board held before it, which moves while some views are taken."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *, moved: tuple[int, ...] = ()) -> None:
        self.rng = np.random.default_rng(2)
        self.moved = moved
        self.seen = 0
        self.asked: list[str] = []
        self.stop: tuple[str, ...] = ()
        monkeypatch.setattr("hardware.measuring.with_board.find_corners", self.corners)

    def corners(self, rgb: np.ndarray, board: BoardSpec) -> Corners:
        self.seen += 1
        R = rotation(*self.rng.uniform(-0.5, 0.5, 3))
        at = [*self.rng.uniform([-0.12, -0.06], [0.12, 0.06]), self.rng.uniform(0.35, 0.6)]
        pixels = projected(BOARD.corners_m, transform(R, at - R @ BOARD.corners_m.mean(axis=0)))
        noise = self.rng.normal(0.0, 20.0 if self.seen in self.moved else 0.1, (len(pixels), 2))
        return Corners(np.arange(len(pixels)), pixels + noise)

    def answer(self, text: str) -> str:
        self.asked.append(text)
        return "q" if any(word in text for word in self.stop) else ""

    def measure(self, folder: Path) -> dict[str, object]:
        self.asked.clear()
        return measure_lens(
            RigConfig(setup=folder, camera="uvc"),
            BOARD,
            views=VIEWS,
            camera=BlindCamera(),
            operator=TerminalOperator(self.answer),
        )

    @property
    def views(self) -> list[str]:
        """Which views were asked for."""
        return [text.split(":")[0] for text in self.asked if text.startswith("view")]


def test_a_lens_takes_the_view_again_that_moved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk = Desk(monkeypatch, moved=(4,))
    found = desk.measure(tmp_path)
    assert desk.views == [f"view {n} of 10" for n in [*range(1, 11), 4]]
    assert found["error_px"] < 0.3  # type: ignore[operator]
    np.testing.assert_allclose(
        read_intrinsics(tmp_path / "lens.json").matrix, INTRINSICS.matrix, atol=8.0
    )
    assert [path.name for path in tmp_path.iterdir()] == ["lens.json"]


def test_a_stopped_lens_goes_on_and_a_refused_one_keeps_its_views(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk = Desk(monkeypatch, moved=(4,))
    desk.stop = ("view 1 ",)
    with pytest.raises(InputError, match="all views were taken; nothing was written"):
        desk.measure(tmp_path)
    assert list(tmp_path.iterdir()) == []
    desk.stop = ("view 7 ",)
    with pytest.raises(InputError, match=r"6 views are kept in .*lens_views\.json"):
        desk.measure(tmp_path)
    desk.stop = ("px only",)
    with pytest.raises(InputError, match=r"take view 4 again .*10 views are kept"):
        desk.measure(tmp_path)
    assert desk.views == [f"view {n} of 10" for n in range(7, 11)]
    assert [path.name for path in tmp_path.iterdir()] == ["lens_views.json"]
    desk.stop = ()
    desk.measure(tmp_path)
    assert desk.views == ["view 4 of 10"]
    assert [path.name for path in tmp_path.iterdir()] == ["lens.json"]


def test_views_of_another_video_device_are_refused(tmp_path: Path) -> None:
    write_json(tmp_path / "lens_views.json", {"schema": 1, "camera_id": "uvc 3", "views": []})
    with pytest.raises(InputError, match=r"lens_views\.json are of the camera_id uvc 3, not uvc;"):
        measure_lens(
            RigConfig(setup=tmp_path, camera="uvc"), BOARD, operator=TerminalOperator(input)
        )
