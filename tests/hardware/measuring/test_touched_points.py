"""`calibrate points`: marks on the foam shown in the picture and touched, and pairs from a file."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from fixtures.blind_camera import BlindCamera
from fixtures.board_photographs import INTRINSICS, TABLE, camera_above
from fixtures.guided_robot import setup
from fixtures.safety_spy import HOME, SpyRobot, joints_at, pose

from hardware.arm.limits import SafetyLimits
from hardware.arm.safe_robot import SafeRobot
from hardware.calibration.calibration import Calibration
from hardware.calibration.homography import apply_homography, plane_homography
from hardware.calibration.poor_fit import PoorFit
from hardware.choosers.human import TerminalOperator
from hardware.measuring.points_file import TouchedPoint, read_points, write_points
from hardware.measuring.with_points import click_point, measure_points, points_from_file, type_point
from hardware.rig.config import RigConfig
from hardware.rig.rig import read_calibration
from hardware.support.json_file import write_json
from warp_deform.command.main import main
from warp_deform.errors import InputError

CAMERA = camera_above(height=0.75, yaw=np.pi / 2 + 0.1)  # the long side along the rows
H = plane_homography(INTRINSICS, CAMERA, TABLE)
MARKS = np.stack(np.meshgrid([0.36, 0.485, 0.61], [-0.24, 0.0, 0.25]), axis=-1).reshape(-1, 2)
TIP, LEAN = 0.009, 0.15


def seen(xy: np.ndarray, seed: int = 0, *, noise: float = 0.5) -> np.ndarray:
    """Where the camera, whose lens distorts, shows points of the table [px]."""
    pixels = INTRINSICS.distort(apply_homography(np.linalg.inv(H), xy))
    return pixels + np.random.default_rng(seed).normal(0.0, noise, pixels.shape)


def true_error(folder: Path) -> float:
    """Greatest error of the calibration on the workspace [m]."""
    calibration = Calibration.load(folder / "calibration.json")
    assert calibration.method == "touched points" and calibration.table == TABLE
    grid = np.stack(np.meshgrid(np.linspace(0.335, 0.635, 7), np.linspace(-0.3, 0.3, 7)), axis=-1)
    xy = grid.reshape(-1, 2)
    found = calibration.pixel_to_base(seen(xy, noise=0.0))[:, :2]
    return float(np.linalg.norm(found - xy, axis=1).max())


# At the table.


class Person:
    """Shows the marks and guides the leaning hand onto them; can put it elsewhere."""

    def __init__(self) -> None:
        self.robot = SpyRobot(object_width=0.0)
        self.asked: list[str] = []
        self.shown: list[int] = []
        self.off: dict[int, np.ndarray] = {}
        self.say: Callable[[str], str | None] = lambda text: None

    def show(
        self, picture: np.ndarray, text: str, operator: TerminalOperator
    ) -> tuple[float, float]:
        index = int(text.split()[1]) - 1
        self.shown.append(index + 1)
        column, row = seen(MARKS)[index]
        return float(column), float(row)

    def answer(self, text: str) -> str:
        self.asked.append(text.split("\n")[0])
        assert len(self.asked) < 40, text
        said = self.say(text)
        if "10 cm above" in text:
            self.robot.q = HOME + 0.02
        guided = re.match(r"point (\d+) of \d+: guide the closed fingertips", text)
        if said is None and guided:
            assert self.robot.width < 1e-3
            index = int(guided[1]) - 1
            xy = MARKS[index] + self.off.pop(index + 1, np.zeros(2))
            T = pose(*xy, float(TABLE.z(xy)), tilt=LEAN)
            T[:3, 3] -= TIP * T[:3, 2]
            self.robot.q = joints_at(T)
        return said or ""

    def measure(self, folder: Path, **options: object) -> dict:
        self.asked.clear()
        self.shown.clear()
        robot = SafeRobot(self.robot, SafetyLimits(table=TABLE))
        return measure_points(
            setup(folder, None),
            camera=BlindCamera(),
            robot=robot,
            operator=TerminalOperator(self.answer),
            **{"show": self.show, **options},
        )


def test_touched_marks_find_the_camera(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    person = Person()
    found = person.measure(tmp_path)
    assert person.shown == list(range(1, 10)) and len(person.asked) == 10
    assert person.robot.log == ["recover", "move_joints", "grasp", "close"]
    assert 0.1e-3 < found["error_m"] < 2e-3 and true_error(tmp_path) < 2.5e-3
    # the tip of a leaning hand is 1.3 mm beside its TCP
    touched = np.array(found["points"])[:, 2:]
    assert np.linalg.norm(touched - MARKS, axis=1).max() < 0.2e-3 < TIP * np.sin(LEAN)
    lines = [line for line in capsys.readouterr().err.splitlines() if "left out" in line]
    assert [line.split(":")[0] for line in lines] == [f"point {n}" for n in range(1, 10)]
    left = [float(line.split("left out ")[1].split()[0]) for line in lines]
    np.testing.assert_allclose(left, 1e3 * np.array(found["left_out_m"]), atol=0.006)
    assert {path.name for path in tmp_path.iterdir()} == {
        "table.json",
        "calibration.json",
        "points_seen.png",
        "workplace.json",
    }


def test_pixels_and_millimetres_may_be_typed(tmp_path: Path) -> None:
    person = Person()
    lines = iter(
        line
        for pixel, xy in zip(seen(MARKS), MARKS, strict=True)
        for line in (
            "12",
            "{:.1f} {:.1f}".format(*pixel),
            "x",
            "{:.0f}, {:.0f}".format(*(1e3 * xy)),
        )
    )
    person.say = lambda text: "" if "lay 9 small" in text else next(lines)
    person.measure(tmp_path, show=type_point)
    assert true_error(tmp_path) < 3e-3


def test_a_wrong_touch_is_named_and_made_again(tmp_path: Path) -> None:
    person = Person()
    person.off = {5: np.array([0.012, -0.009])}
    person.measure(tmp_path)
    assert person.shown == [*range(1, 10), 5] and true_error(tmp_path) < 2.5e-3
    assert any("measure point 5 again first" in text for text in person.asked)


def test_a_refused_result_is_gone_on_from(tmp_path: Path) -> None:
    person = Person()
    person.off = {5: np.array([0.012, -0.009])}
    person.say = lambda text: "q" if "refused" in text else None
    with pytest.raises(
        InputError, match=r"point 5 again first; 9 points are kept in .*points\.csv"
    ):
        person.measure(tmp_path)
    assert not (tmp_path / "calibration.json").exists()
    person.say = lambda text: None
    person.measure(tmp_path)
    assert person.shown == [5] and true_error(tmp_path) < 2.5e-3
    assert not (tmp_path / "points.csv").exists()


@pytest.mark.parametrize("interrupted", [True, False])
def test_stopped_and_interrupted_touching_goes_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], interrupted: bool
) -> None:
    person = Person()

    def say(text: str) -> str | None:
        if not text.startswith("point 6"):
            return None
        if interrupted:
            raise KeyboardInterrupt
        return "q"

    person.say = say
    with pytest.raises(KeyboardInterrupt if interrupted else InputError) as caught:
        person.measure(tmp_path)
    where = capsys.readouterr().err if interrupted else str(caught.value)
    assert "5 points are kept in" in where and "points.csv" in where
    person.say = lambda text: None
    person.measure(tmp_path)
    assert person.shown == [6, 7, 8, 9] and true_error(tmp_path) < 2.5e-3


def test_what_cannot_be_meant_is_asked_again(tmp_path: Path) -> None:
    person = Person()
    person.off = {2: MARKS[0] - MARKS[1]}  # the first mark once more
    high = iter([True])

    def say(text: str) -> str | None:
        if text.startswith("point 3") and next(high, False):
            person.robot.q = joints_at(pose(*MARKS[2], 0.06))
            return ""
        return "0.36 -0.24" if text.startswith("point 4") and next(metres, False) else None

    metres = iter([True])
    person.say = say
    person.measure(tmp_path)
    said = "\n".join(person.asked)
    assert "points 1 and 2 are nearer than 10 mm" in said
    assert "the fingertips are 37 mm above the touched-off table (allowed: 10 mm)" in said
    assert "point 4: x 0.00036 m, y -0.00024 m is far from the workspace" in said
    assert person.shown == [1, 2, 2, 3, 4, 4, 5, 6, 7, 8, 9] and true_error(tmp_path) < 2.5e-3


def test_points_in_one_corner_get_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    near = np.array([[0.36, -0.2], [0.36, -0.05], [0.45, -0.2], [0.45, -0.05], [0.4, -0.12]])
    marks = np.vstack([near, MARKS[[0, 2, 6, 8]] + 0.02])
    monkeypatch.setattr("test_touched_points.MARKS", marks)
    person = Person()
    person.measure(tmp_path, points=5)
    assert person.shown == list(range(1, len(person.shown) + 1)) and len(person.shown) > 6
    assert any("enclose 8 % of the workspace, 33 % are needed" in text for text in person.asked)
    assert any("no one point is to blame" in text for text in person.asked)
    assert true_error(tmp_path) < 4e-3


def test_too_few_points_and_no_display_are_said_before_the_arm_moves(tmp_path: Path) -> None:
    person = Person()
    with pytest.raises(InputError, match="--points is 4; 5 are needed"):
        person.measure(tmp_path, points=4)
    matplotlib.use("agg")
    with pytest.raises(InputError, match="give --typed"):
        person.measure(tmp_path, show=None)
    assert not person.asked and not person.robot.joints


def test_a_click_is_a_pixel(monkeypatch: pytest.MonkeyPatch) -> None:
    import matplotlib.pyplot as plt

    monkeypatch.setattr(matplotlib, "get_backend", lambda: "qtagg")
    for clicks, expected in (([(412.25, 230.5)], (412.25, 230.5)), ([], None)):
        monkeypatch.setattr(plt, "ginput", lambda n, timeout, clicks=clicks: clicks)
        picture = np.zeros((72, 128, 3), np.uint8)
        assert click_point(picture, "point 1", TerminalOperator(lambda _: "")) == expected
    assert not plt.get_fignums()


# From a file.

PANDA = ("--robot", "panda", "--host", "10.0.0.1")


def lab(folder: Path) -> RigConfig:
    """A measured table and lens."""
    setup(folder, None)
    write_json(folder / "lens.json", {"schema": 1, **INTRINSICS.to_record(), "error_px": 0.2})
    return RigConfig(setup=folder, robot="panda", host="10.0.0.1", camera="uvc")


def rows(xy: np.ndarray = MARKS, seed: int = 0) -> list[str]:
    table = np.hstack([seen(xy, seed), xy + np.random.default_rng(seed).normal(0, 3e-4, xy.shape)])
    return ["{:.1f}, {:.1f}, {:.4f}, {:.4f}".format(*row) for row in table]


def calibrate(capfd: pytest.CaptureFixture[str], *words: str) -> tuple[int, dict, list[str]]:
    code = main(["franka", "calibrate", "points", *words, "--json"])
    said = capfd.readouterr()
    return code, json.loads(said.out) if said.out else {}, said.err.strip().splitlines()


@pytest.mark.parametrize("seed", range(3))
def test_a_file_of_pairs_calibrates_without_a_robot(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], seed: int
) -> None:
    config, file = lab(tmp_path), tmp_path / "pairs.csv"
    file.write_text("\ufeff# of Monday\n\n" + "\n".join(rows(seed=seed)).replace(",", ";") + "\n")
    code, data, said = calibrate(capfd, *PANDA, "--setup", str(tmp_path), "--pairs", str(file))
    assert code == 0 and len(data["points"]) == len(data["left_out_m"]) == 9
    assert data["error_m"] < 2.5e-3 and true_error(tmp_path) < 3e-3
    assert sum("residual" in line for line in said) == 9
    assert read_calibration(config).details["points"] == data["points"]


def changed(index: int, column: int, add: float) -> list[str]:
    lines = [[float(word) for word in row.split(",")] for row in rows()]
    lines[index][column] += add
    return [", ".join(map(str, line)) for line in lines]


ORIGIN = "# calibrate points: robot panda 10.0.0.{}, camera uvc, 1280 x 720 px"


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (changed(3, 2, 0.015), r"allowed: 3 mm rms, so it is refused; measure point 4 again first"),
        (changed(3, 2, 0.3), r"point 4: x 0\.6\d* m, y .*|measure point 4 again first"),
        (rows()[:4], "4 points: four fit any homography, so 5 are needed"),
        ([], "0 points"),
        (rows(MARKS * [0.5, 0.3] + [0.2, 0.0]), "enclose 10 % of the workspace, 33 % are needed"),
        (rows(MARKS * [0.0, 1.0] + [0.4, 0.0])[::3], "3 points"),
        ([*rows(), rows()[0]], "points 1 and 10 are nearer than 10 mm"),
        (
            [" ".join(np.array(r.split(", "))[[1, 0, 2, 3]]) for r in rows()],
            "give the column|wrong way",
        ),
        (["10 20 0.4"], r"line 1 of .*pairs\.csv is '10 20 0\.4'; a point is four numbers"),
        (["a,b,c,d", *rows()], "line 1 .* four numbers"),
        (["1, 2, 3, nan"], "line 1 .* four numbers"),
        (["1280.0, 3, 0.4, 0.1"], "outside of the picture of 1280 x 720"),
        (["412, 230, 400, -200"], r"point 1: x 400 m, y -200 m is far from .*check the unit"),
        ([ORIGIN.format(9), *rows()], r"points in .*pairs\.csv are of 'robot panda 10\.0\.0\.9"),
    ],
    ids=lambda value: value if isinstance(value, str) else f"{len(value)} lines",
)
def test_bad_pairs_are_one_line_and_write_nothing(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], lines: list[str], message: str
) -> None:
    lab(tmp_path)
    file = tmp_path / "pairs.csv"
    file.write_text("\n".join(lines))
    code, _, said = calibrate(capfd, *PANDA, "--setup", str(tmp_path), "--pairs", str(file))
    assert code == 2 and re.search(message, said[-1]), said[-1]
    assert not any("Traceback" in line for line in said)
    assert not (tmp_path / "calibration.json").exists()


def test_a_refused_file_shows_every_residual(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    config = lab(tmp_path)
    file = tmp_path / "pairs.csv"
    file.write_text("\n".join([ORIGIN.format(1), *changed(3, 3, -0.012)]))
    with pytest.raises(PoorFit) as caught:
        points_from_file(config, file)
    assert caught.value.worst == 3
    assert sum("left out" in line for line in capfd.readouterr().err.splitlines()) == 9


def test_whose_pairs_and_which_lens_must_be_known(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    lab(tmp_path)
    file = tmp_path / "pairs.csv"
    file.write_text("\n".join(rows()))
    pairs = ("--setup", str(tmp_path), "--pairs", str(file))
    for robot in ((), ("--robot", "panda")):
        code, _, said = calibrate(capfd, *robot, *pairs)
        assert code == 2 and "whose are the points" in said[-1]
    code, _, said = calibrate(capfd, *PANDA, *pairs[:3], str(tmp_path / "none.csv"))
    assert code == 2 and "none.csv cannot be read" in said[-1]
    (tmp_path / "none.csv").write_bytes(b"\xff\xfe\x00")
    code, _, said = calibrate(capfd, *PANDA, *pairs[:3], str(tmp_path / "none.csv"))
    assert code == 2 and "are no text" in said[-1]
    for step in ("lens", "table"):
        (tmp_path / f"{step}.json").unlink()
        code, _, said = calibrate(capfd, *PANDA, *pairs)
        assert code == 2 and f"`warp-deform franka calibrate {step}` first" in said[-1]


def test_a_camera_that_tells_its_intrinsics_is_opened_for_them(tmp_path: Path) -> None:
    setup(tmp_path, None)
    file = tmp_path / "pairs.csv"
    file.write_text("\n".join(rows()))
    config = RigConfig(setup=tmp_path, robot="fr3", host="10.0.0.2", camera="realsense")
    points_from_file(config, file, camera=BlindCamera())
    assert true_error(tmp_path) < 3e-3


def test_points_are_read_as_they_were_written(tmp_path: Path) -> None:
    points = [TouchedPoint(412.25, 230.5, 0.36012, -0.24), TouchedPoint(0.0, 1.0, 0.5, 0.1)]
    write_points(tmp_path / "p.csv", points, ORIGIN.format(1))
    assert read_points(tmp_path / "p.csv", ORIGIN.format(1)) == points
    with pytest.raises(InputError, match=r"not of .*10\.0\.0\.2"):
        read_points(tmp_path / "p.csv", ORIGIN.format(2))
    (tmp_path / "p.csv").write_text("1 2 3 4\n" * 501)
    with pytest.raises(InputError, match="more than 500"):
        read_points(tmp_path / "p.csv", "")
