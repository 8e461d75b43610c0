"""The home pose and the workspace of a setup: what is allowed, seen, stored and refused."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fixtures.filmed_rig import filmed
from fixtures.franka_arm import Arm, episode
from fixtures.franka_episodes import ACTION, CALIBRATION, LIMITS
from fixtures.guided_robot import Homing

from hardware.arm.panda import HOME_Q, PandaKinematics
from hardware.arm.safe_robot import SafeRobot
from hardware.arm.table_plane import TablePlane
from hardware.calibration.calibration import Calibration
from hardware.calibration.picture_coverage import camera_pose, check_picture, outside
from hardware.calibration.reach import check_workplace
from hardware.calibration.workplace import Workplace
from hardware.choosers.human import TerminalOperator
from hardware.measuring.points_file import origin_line
from hardware.measuring.steps import touched_table
from hardware.measuring.with_board import measure_table
from hardware.recordings.pack import pack
from hardware.rig.config import RigConfig
from hardware.rig.rig import open_rig, read_calibration
from hardware.rig.workplace import workplace_of
from hardware.twin.camera import SimCameraConfig, sim_calibration
from hardware.twin.twin import TwinConfig
from hardware.vision.task_frame import fits_task, to_base, to_task
from warp_deform.command.main import main
from warp_deform.errors import InputError
from warp_deform.tasks.cable_mask_goal import CableMaskGoal

PAPER_HOME = (0.0, -np.pi / 4, 0.0, -3 * np.pi / 4, 0.0, np.pi / 2, np.pi / 4)
PAPER = Workplace(home_q=PAPER_HOME, x=(0.31, 0.63), y=(-0.31, 0.33))
PAPER_ENDS = 0.31, 0.63, -0.31, 0.33
FOAM = TablePlane(0.03)
TILTED = (0.0, -0.8612, 0.0, -2.4243, 0.0, 1.6678, 0.7854)
"""The home pose that shows all of the workspace to a C920 as in the twin."""


def test_the_papers_home_pose_and_workspace_are_possible() -> None:
    """frankapy: HOME_JOINTS, HOME_POSE; gctn_physical: the limits of x and y."""
    assert Workplace().home_q == PAPER_HOME
    expected = np.diag([1.0, -1.0, -1.0, 1.0])
    expected[:3, 3] = 0.3069, 0.0, 0.4867
    np.testing.assert_allclose(PandaKinematics().pose(np.array(PAPER_HOME)), expected, atol=3e-4)
    assert check_workplace(Workplace(), Workplace().limits(FOAM)) is None
    part = check_workplace(PAPER, PAPER.limits(FOAM))
    assert part is not None and "3 % of the workspace, within x 0.310 to 0.310" in part
    twin = TwinConfig(view=PAPER.view)
    check_picture(sim_calibration(twin), PAPER.limits(FOAM))
    assert PAPER.view.pixel_m == pytest.approx(2e-3) and fits_task(PAPER.view)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"home_q": (0.0,) * 6}, "seven joint positions"),
        ({"home_q": (np.nan, *HOME_Q[1:])}, "seven joint positions"),
        ({"home_q": (*HOME_Q[:3], 0.1, *HOME_Q[4:])}, "joint 4 at 0.1 rad; allowed: -3.0718 to"),
        ({"x": (0.63, 0.31)}, "lower end first: X0 X1 Y0 Y1"),
        ({"x": (np.inf, 0.635)}, "not finite"),
        ({"y": (-0.3, 0.33)}, "0.3 x 0.63 m; it must be twice as long along y as along x, 0.6 m"),
        ({"x": (0.4, 0.5), "y": (-0.1, 0.1)}, "0.1 m along x; allowed: 0.2 to 0.5 m"),
        ({"x": (0.6, 0.9)}, "0.95 m from the base's axis"),
        ({"x": (-0.1, 0.2)}, "reaches 0.855 m"),
    ],
)
def test_what_the_arm_cannot_have_is_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=re.escape(message)) as refused:
        replace(Workplace(), **change)
    assert "\n" not in str(refused.value) and str(refused.value).startswith("--")


@pytest.mark.parametrize(
    ("workplace", "message"),
    [
        (Workplace(home_q=(1.2, *HOME_Q[1:])), "(0.111, 0.286, 0.487) m, beyond workspace x, low"),
        (Workplace(home_q=(*HOME_Q[:5], HOME_Q[5] + 0.7, HOME_Q[6])), "beyond tilt of the hand"),
        (Workplace(home_q=(*HOME_Q[:6], 2.8)), "joint 7 at 2.800 rad; allowed: -2.608 to 2.608"),
        (Workplace(home_q=(0.0, 0.3, 0.0, -2.6, 0.0, 2.9, 0.785)), "m above the table; 0.05 m are"),
        (
            Workplace(x=(0.24, 0.54), y=(-0.3, 0.3)),
            "--workspace 0.24 0.54 -0.3 0.3: the hand does not get down to",
        ),
    ],
    ids=["beside", "tilted", "margin", "low", "too near"],
)
def test_a_home_beyond_the_limits_and_a_workspace_out_of_reach_are_refused(
    workplace: Workplace, message: str
) -> None:
    with pytest.raises(InputError, match=re.escape(message)):
        check_workplace(workplace, workplace.limits(FOAM))


def c920(focal_px: float = 907.0, twin: TwinConfig | None = None) -> Calibration:
    """A calibration of a narrower camera on the twin's hand; 907 px is a C920, 931 px a D435."""
    return sim_calibration(twin, SimCameraConfig(focal_px=focal_px))


@pytest.mark.parametrize(("focal_px", "share", "degrees"), [(907.0, 20, 6), (931.0, 22, 7)])
def test_a_narrow_camera_is_told_what_it_misses_and_what_tilt_shows_it(
    focal_px: float, share: int, degrees: int
) -> None:
    calibration = c920(focal_px)
    with pytest.raises(InputError) as refused:
        check_picture(calibration, LIMITS)
    said = str(refused.value)
    assert said.startswith(f"{share} % of the workspace is outside of the camera's picture")
    assert re.search(r"corner \(0\.635, -?0\.300\) m by 1\d\d px", said)
    home = re.search(rf"tilt the hand there by {degrees} degrees: --home ([-\d. ]+\d)", said)
    assert home is not None and "raise" not in said, "0.6 m is the ceiling"
    cured = TwinConfig(home_q=tuple(float(word) for word in home[1].split()))
    found, _, pixels = outside(c920(focal_px, cured))
    assert found == 0.0 and pixels < 0.0
    check_picture(c920(focal_px, cured), LIMITS)


def test_where_a_little_is_missing_raising_the_hand_shows_it() -> None:
    with pytest.raises(InputError, match=r"raise it by \d cm: --home") as refused:
        check_picture(c920(725.0), LIMITS)
    words = str(refused.value).split("raise it by ")[1].split("--home ")[1].split(";")[0]
    cured = TwinConfig(home_q=tuple(float(word) for word in words.split()))
    assert outside(c920(725.0, cured))[0] == 0.0


def test_the_whole_picture_needs_no_cure_and_no_lens_may_have_one() -> None:
    check_picture(CALIBRATION, LIMITS)
    with pytest.raises(InputError, match="a wider lens; or give a smaller --workspace"):
        check_picture(c920(3000.0), LIMITS)


def test_the_camera_is_where_its_homography_says() -> None:
    """On a table that slopes, too; the sign and the scale are not in a homography."""
    true = PandaKinematics().pose(np.array(TILTED)) @ SimCameraConfig().tcp_T_camera
    from hardware.calibration.homography import plane_homography

    table = TablePlane(0.02, slope_x=0.03, slope_y=-0.02)
    H = plane_homography(CALIBRATION.intrinsics, true, table)
    for sign in (1.0, -2.5):
        found = camera_pose(replace(CALIBRATION, base_H_pixel=sign * H, table=table))
        np.testing.assert_allclose(found, true, atol=1e-9)


# Stored with a setup.


def test_what_a_setup_was_calibrated_for_is_used_and_nothing_else(tmp_path: Path) -> None:
    config = filmed(tmp_path)
    calibration = replace(CALIBRATION, home_q=np.array(TILTED), x=PAPER.x, y=PAPER.y)
    calibration.save(tmp_path / "calibration.json")
    with open_rig(config) as rig:
        assert rig.view == PAPER.view and rig.robot.limits.x == PAPER.x
        np.testing.assert_allclose(rig.robot.state().q, TILTED)
    typed = replace(config, home=tuple(round(q, 4) for q in TILTED), workspace=PAPER_ENDS)
    assert read_calibration(typed).workplace == calibration.workplace
    for change, message in (
        ({"home": HOME_Q}, "is of --home 0.0000 -0.8612 .*, not --home 0.0000 -0.7854"),
        ({"workspace": (0.335, 0.635, -0.3, 0.3)}, "not --workspace 0.335 0.635 -0.3 0.3; leave"),
    ):
        with pytest.raises(InputError, match=message):
            read_calibration(replace(config, **change))
    Workplace(home_q=TILTED).save(tmp_path)
    with pytest.raises(InputError, match=r"0\.33, not .*; calibrate camera .* again"):
        read_calibration(config)


def test_a_calibration_from_before_is_of_the_workspace_there_was(tmp_path: Path) -> None:
    path = tmp_path / "calibration.json"
    CALIBRATION.save(path)
    record = json.loads(path.read_text())
    assert record.pop("workspace") == [0.335, 0.635, -0.3, 0.3]
    path.write_text(json.dumps(record))
    assert Calibration.load(path).workplace == Workplace()
    path.write_text(json.dumps({**record, "workspace": [0.3, 0.6, -0.3]}))
    with pytest.raises(InputError, match="workspace is not"):
        Calibration.load(path)
    path.write_text(json.dumps({**record, "workspace": [0.3, 0.6, -0.3, 0.4]}))
    with pytest.raises(InputError, match="twice as long"):
        Calibration.load(path)


def test_the_table_is_touched_within_the_workspace_and_stores_it(tmp_path: Path) -> None:
    spy = Homing(object_width=0.0)
    config = RigConfig(setup=tmp_path, robot="fr3", home=TILTED, workspace=PAPER_ENDS)
    limits = PAPER.limits(TablePlane(-0.015))
    measure_table(
        config,
        provisional_z=-0.015,
        robot=SafeRobot(spy, limits, home_q=TILTED),
        operator=TerminalOperator(lambda text: ""),
    )
    later = replace(config, home=None, workspace=None)
    stored = workplace_of(later)
    assert (stored.x, stored.y, stored.home_q) == (PAPER.x, PAPER.y, TILTED)
    assert touched_table(later).height_m == pytest.approx(spy.true.height_m, abs=1e-4)
    with pytest.raises(InputError, match="calibrate table with that workspace first"):
        touched_table(replace(config, workspace=(0.335, 0.635, -0.3, 0.3)))
    moved = replace(later, home=HOME_Q)
    assert workplace_of(moved).home_q == HOME_Q and touched_table(moved) == touched_table(later)


def test_a_damaged_file_is_one_line(tmp_path: Path) -> None:
    assert Workplace.load(tmp_path) is None
    PAPER.save(tmp_path)
    assert Workplace.load(tmp_path) == PAPER
    path = tmp_path / "workplace.json"
    good = json.loads(path.read_text())
    for damage in (
        {"home_q": [0.0]},
        {"workspace": "x"},
        {"workspace": [0.6, 0.3, 0, 1]},
        {"schema": 2},
    ):
        path.write_text(json.dumps({**good, **damage}))
        with pytest.raises(InputError, match=r"workplace"):
            Workplace.load(tmp_path)


def test_points_of_another_home_pose_are_not_gone_on_from(tmp_path: Path) -> None:
    config = RigConfig(setup=tmp_path, robot="panda", host="10.0.0.1", camera="uvc")
    usual = origin_line(config, CALIBRATION.intrinsics)
    assert "home" not in usual
    tilted = origin_line(replace(config, home=TILTED), CALIBRATION.intrinsics)
    home = Workplace(home_q=TILTED).home_text()
    assert tilted == usual.replace(", 640 x", f", {home}, 640 x")


# What acts in it.


def test_a_pixel_is_the_same_point_for_the_task_and_the_workspace() -> None:
    xy = np.random.default_rng(0).uniform((0.335, -0.3), (0.635, 0.3), (50, 2))
    np.testing.assert_allclose(to_base(xy, Workplace().view), xy, atol=1e-12)
    elsewhere = to_base(xy, PAPER.view)
    np.testing.assert_allclose(
        PAPER.view.base_to_pixel(elsewhere), CableMaskGoal.grid.fractional(xy), atol=1e-9
    )
    np.testing.assert_allclose(to_task(elsewhere, PAPER.view), xy, atol=1e-12)
    small = Workplace(x=(0.4, 0.6), y=(-0.2, 0.2))
    assert not fits_task(small.view)


def test_a_demonstration_is_packed_at_its_pixels(tmp_path: Path) -> None:
    episode(tmp_path / "a", Arm(), [ACTION], max_actions=1)
    packed = pack(tmp_path / "a", seed=0).steps[0].action
    assert packed is not None
    np.testing.assert_allclose(
        packed[[0, 1, 3, 4]], [*ACTION.pick_xy, *ACTION.place_xy], atol=1e-12
    )
    meta = tmp_path / "a" / "episode.json"
    record = json.loads(meta.read_text())
    record["config"]["episode"]["view"] |= {"x": list(PAPER.x), "y": list(PAPER.y)}
    meta.write_text(json.dumps(record))
    moved = pack(tmp_path / "a", seed=0).steps[0].action
    assert moved is not None
    pixel = PAPER.view.base_to_pixel(np.array(ACTION.pick_xy))
    np.testing.assert_allclose(CableMaskGoal.grid.fractional(moved[:2]), pixel, atol=1e-9)
    assert moved[2] == packed[2] and moved[5] == packed[5]


def test_an_episode_in_the_papers_workspace_from_a_tilted_home(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "a"
    place = ["--workspace", *map(str, PAPER_ENDS), "--home", *map(str, TILTED)]
    options = ["--robot", "sim", "--agent", "scripted", "--seed", "4", "--max-actions", "1"]
    code = main(["franka", "run", *options, *place, "--out", str(folder), "--json"])
    said = capfd.readouterr()
    assert code == 0 and "does not get down to 3 %" in said.err
    assert json.loads(said.out)["outcomes"] == ["placed"]
    calibration = Calibration.load(folder / "calibration.json")
    assert calibration.workplace == replace(PAPER, home_q=TILTED)
    assert main(["franka", "replay", str(folder)]) == 0
    readings = [json.loads(line) for line in (folder / "robot.jsonl").read_text().splitlines()]
    np.testing.assert_allclose(readings[0]["q"], TILTED, atol=1e-9)


def test_run_refuses_what_the_simulated_camera_does_not_see(
    capfd: pytest.CaptureFixture[str],
) -> None:
    up = [f"{q:.4f}" for q in HOME_Q]
    up[5] = "1.9708"
    assert main(["franka", "run", "--robot", "sim", "--home", *up]) == 2
    (line,) = capfd.readouterr().err.strip().splitlines()
    assert "of the workspace is outside of the camera's picture" in line and "--home" in line
