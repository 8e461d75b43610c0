"""`warp-deform gradcheck`: its rows are right, and wrong derivatives would show in them."""

import functools
import itertools
import json
import re
import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fixtures.places import ROOT

from warp_deform.command.main import main
from warp_deform.gradcheck import GradcheckConfig, Row, check, wrong
from warp_deform.gradcheck.branches import taken
from warp_deform.gradcheck.differences import DEEPEST, RUNGS, WORLDS, Sample, _depths, compare
from warp_deform.gradcheck.draws import Draw, draw_states
from warp_deform.gradcheck.limits import RATIO, central, kink
from warp_deform.rollout import DifferentiableRollout, Gradients, rollout
from warp_deform.tasks.cable_shape import CableShape
from warp_deform.worlds import Worlds
from warp_deform.xpbd.lanes.tape import Kind

pytestmark = pytest.mark.in_a_row("adjoints")

LINE = "cable-line-notarget"
FEW = GradcheckConfig(levels=("substep",), states=4)
MORE = replace(FEW, states=16)
"""Stiffness moves a sheet so little in a substep that single differences are wrong by 2e-6."""
OF_WORLD = {"damping", "table_friction", "contact_friction", "stiffness"}
OF_PATH = {"waypoints", "knot_times", "knot_rotations"}
OF_PARTICLES = {"positions", "velocities", "inverse_masses", "spring_stiffness", "rest_lengths"}
OF_PARTICLES |= {"radii"}
OF_BODIES = {"body_poses", "body_velocities", "body_inverse_masses"}
PARAMETERS = {
    LINE: OF_PARTICLES | OF_PATH | OF_WORLD,
    "fabric-flat": OF_PARTICLES | OF_PATH | OF_WORLD,
    "block-notarget": OF_BODIES | OF_PATH | OF_WORLD,
}


def overall(rows: list[Row]) -> dict[str, Row]:
    return {row.parameter: row for row in rows if row.constraint == "all"}


@functools.cache
def checked(task: str) -> list[Row]:
    """Rows of a task's substeps."""
    return check(task, MORE if task == "fabric-flat" else FEW)[0]


@pytest.mark.parametrize("task", PARAMETERS)
def test_substeps_of_real_episodes_agree(task: str) -> None:
    rows = checked(task)
    of_all = overall(rows)
    assert set(of_all) == PARAMETERS[task] | {"all"}
    for row in rows:
        assert row.task == task and row.level == "substep" and row.dtype == "float64"
        assert row.relative_error is None or row.relative_error < 1e-6, row
    assert of_all["all"].share >= 0.5 and of_all["all"].within == 1.0
    assert of_all["stiffness"].n == of_all["all"].states >= 4
    least = {"body_table", "grip"} if task == "block-notarget" else {"stretch", "grip", "table"}
    assert least <= {row.constraint for row in rows}


def test_cables_solved_directly_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    stiff = replace(CableShape.cable, bend_stiffness=200.0, solve="direct")
    monkeypatch.setattr(CableShape, "cable", stiff)
    rows, _ = check(LINE, FEW)
    assert {"bend", "stretch", "grip", "table"} <= {row.constraint for row in rows}
    for row in rows:
        assert row.relative_error is None or row.relative_error < 1e-6, row
    assert overall(rows)["all"].within == 1.0


def test_a_wrong_derivative_shows_and_fails_the_command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    right = DifferentiableRollout.backward

    def off(self: DifferentiableRollout, **cotangents: np.ndarray) -> Gradients:
        gradients = right(self, **cotangents)
        return replace(gradients, velocities=1.01 * gradients.velocities)

    monkeypatch.setattr(DifferentiableRollout, "backward", off)
    rows, _ = check(LINE, FEW)
    of_all = overall(rows)
    error = of_all["velocities"].relative_error
    assert error is not None and error > 1e-3
    assert of_all["velocities"].within < 0.5
    assert of_all["positions"].relative_error < 1e-6
    assert {"velocities", "all"} == {row.parameter for row in wrong(rows)}
    few = ["--levels", "substep", "--states", "2", "--summary"]
    assert main(["gradcheck", LINE, *few]) == 1
    assert f"{LINE}, substep, by velocities" in capsys.readouterr().err


def test_a_derivative_that_misses_once_is_not_wrong() -> None:
    """Near a branch single differences are off by more than they tell."""
    rows = checked(LINE)
    assert wrong(rows) == []
    one_off = [replace(row, within=(0.992 if row.parameter == "all" else 0.9)) for row in rows]
    assert wrong(one_off) == []
    assert wrong([replace(row, within=0.98) for row in rows]) != []


def test_windows() -> None:
    rows, _ = check(LINE, GradcheckConfig(levels=("window",), windows=2))
    of_all = overall(rows)
    assert set(of_all) == PARAMETERS[LINE] | {"all"} and len(rows) == len(of_all)
    assert all(0.0 <= row.share <= 1.0 for row in rows)
    assert of_all["velocities"].growth is None and of_all["positions"].growth > 0
    assert of_all["all"].states == 2


STEPS = 1e-2 / RATIO ** np.arange(5)


def test_limits_of_differences() -> None:
    value, error = central(np.sin(1 + STEPS) - np.sin(1 - STEPS), STEPS, 1e-16)
    assert abs(value - np.cos(1)) <= error < 1e-12
    bent, error = kink(np.exp(STEPS) - 2 + np.exp(-STEPS), STEPS, 1e-16)
    assert abs(bent) <= 3 * error < 1e-9
    bent, error = kink(2 * STEPS + STEPS**2, STEPS, 1e-16)  # of |x| + x^2 / 2
    assert bent == pytest.approx(2.0, abs=1e-9) and error < 1e-9


def test_a_jump_between_the_steps_leaves_those_above_it_out() -> None:
    changes = np.where(STEPS > 2e-4, -2 * STEPS, 2 * np.sin(STEPS))
    value, error = central(changes, STEPS, 1e-18)
    assert value == pytest.approx(1.0, abs=1e-9) and error < 1e-6


def test_a_ladder_goes_on_while_contacts_cross_it_and_rounding_is_small() -> None:
    same = np.ones((RUNGS, 3), dtype=bool)
    same[-1, 1:] = False
    values = [np.ones(2), np.ones(2), np.full(2, 1e-7)]
    depths = _depths(np.ones(3), values, noise=1e-15, same=same, bound=1e-6)
    assert depths.tolist() == [RUNGS, DEEPEST, RUNGS]


def of_times(early: float) -> list[Sample]:
    """Samples by knot times over 4 substeps, with a knot so many substeps before the third ends."""
    worlds = Worlds(LINE, WORLDS, lanes=1, precision="float64")
    run = DifferentiableRollout(worlds.solver, storage="full")
    dt = worlds.solver.config.dt
    draws = draw_states(worlds, np.random.default_rng(0), seed=0)
    draw = next(draw for draw in draws if draw.path is not None and draw.path.times[-1] > 10 * dt)
    path = draw.path
    knots = path.positions[[0, 0, 0]] + np.array([[0, 0, 0], [0, 1e-4, 2e-4], [0, 3e-4, 1e-4]])
    times = np.array([0.0, 3.0 - early, 10.0]) * dt
    path = replace(path, times=times, positions=knots, rotations=None, lower=None)
    rng = np.random.default_rng(1)
    samples = compare(run, worlds, replace(draw, path=path), 4, rng, bound=1e-6, directions=3)
    return [sample for sample in samples if sample.parameter == "knot_times"]


def test_a_knot_at_the_end_of_a_substep_is_a_branch() -> None:
    """Its time has a derivative on either side, and no other."""
    assert all(sample.doubt is not None and sample.error < 1e-6 for sample in of_times(0.5))
    assert all(sample.doubt is None for sample in of_times(1e-9))


def some_held(task: str, count: int) -> tuple[Worlds, DifferentiableRollout, Draw]:
    """A state in which something is held, for a while yet."""
    worlds = Worlds(task, count, lanes=1, precision="float64")
    run = DifferentiableRollout(worlds.solver, storage="full")
    draws = draw_states(worlds, np.random.default_rng(0), seed=0)
    long = 20 * worlds.solver.config.dt
    draw = next(draw for draw in draws if draw.path is not None and draw.path.times[-1] > long)
    return worlds, run, draw


@pytest.mark.parametrize("task", ["fabric-flat", "block-notarget"])
def test_equal_worlds_take_the_same_branches(task: str) -> None:
    """Who touched whom is numbered within each world."""
    worlds, run, draw = some_held(task, 3)
    for world in range(3):
        worlds.restore(world, draw.state)
    dt = worlds.solver.config.dt
    # pulls tethers taut
    path = replace(draw.path, positions=draw.path.positions + np.array([0, 0, 0.01]))
    run.forward(range(3), [20 * dt], paths=dict.fromkeys(range(3), path))
    first, *others = taken(run)
    assert task == "block-notarget" or run.backward().counts()["tether"] > 0
    assert all(np.array_equal(first, words) for words in others)


def test_what_a_body_met_before_ends_its_descent_and_no_later_one() -> None:
    worlds, run, draw = some_held("block-notarget", WORLDS)
    for lift, touching in ((0.1, 1), (0.1, 0)):
        state = replace(draw.state, body_x=draw.state.body_x + np.array([0, 0, lift]))
        path = replace(
            draw.path,
            positions=draw.path.positions + np.array([0, 0, lift]),
            lower=(0.0, 0.5 * draw.path.times[-1]),
        )
        ends = Draw(state, path, np.full_like(draw.touching, touching))
        samples = compare(run, worlds, ends, 1, np.random.default_rng(1), bound=1e-6)
        assert (samples[0].fired[Kind.REACHED] > 0) == touching
        known = [s for s in samples if s.doubt is not None and s.doubt < 1e-6]
        assert len(known) > 6 and all(s.error < 1e-6 for s in known)


def places(worlds: Worlds) -> np.ndarray:
    """Particles and bodies of world 0 (n, 3) [m]."""
    poses, _ = worlds.solver.data.body_poses(0)
    return np.vstack([worlds.solver.particle_q(0), poses[:, :3]])


@pytest.mark.parametrize("task", [LINE, "block-notarget"])
def test_drawn_states_go_on_as_the_action_does(task: str) -> None:
    worlds = Worlds(task, WORLDS, lanes=1, precision="float64")
    dt = worlds.solver.config.dt
    held = 0
    for draw in itertools.islice(draw_states(worlds, np.random.default_rng(0), seed=0), 20):
        worlds.restore(0, draw.state)
        start = places(worlds)
        paths = {} if draw.path is None else {0: draw.path}
        rollout(worlds.solver, [0], paths=paths, min_seconds=1e3, max_seconds=dt)
        moved = np.linalg.norm(places(worlds) - start, axis=1).max()
        assert moved < 1.1 * dt, "nothing is faster than an unloaded tip, 1 m/s"
        held += draw.path is not None
    assert held > 0


def test_the_command(capsys: pytest.CaptureFixture[str]) -> None:
    few = ["--levels", "substep", "--states", "2", "--json"]
    assert main(["gradcheck", LINE, *few]) == 0
    said = capsys.readouterr()
    answer = json.loads(said.out)
    assert any("fewer than 20" in note for note in answer["notes"])
    keys = ["task", "level", "constraint", "parameter", "relative_error", "cosine", "share"]
    assert list(answer["rows"][0]) == [
        *keys, "growth", "dtype", "n", "states", "within", "doubtful"
    ]  # fmt: skip
    assert main(["gradcheck", LINE, *few, "--summary"]) == 0
    (line,) = json.loads(capsys.readouterr().out)["summary"]
    named = [r for r in answer["rows"] if r["constraint"] == line["constraint"]]
    assert line["worst"] in [r["relative_error"] for r in named]
    assert line["states"] >= 2 and "grip" in line["seldom"]
    assert main(["gradcheck", "cable-lin", *few]) == 2
    assert main(["gradcheck", LINE, "--states", "0"]) == 2
    assert "--states is 0" in capsys.readouterr().err


def test_the_example_of_the_docs_runs(tmp_path: Path) -> None:
    """Its descent, clipped to 2 mm a knot, brings the cable nearer to where the docs want it."""
    page = ROOT / "docs" / "gradients.md"
    (code,) = re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)
    program = tmp_path / "example.py"
    program.write_text(code)
    names = runpy.run_path(str(program))
    slope = names["gradients"].waypoints[0]
    assert np.isfinite(slope).all() and slope[3, 1] < 0

    knots = names["knots"] - 2e-3 * slope / np.abs(slope).max() * [[0], [1], [1], [1]]
    moved = replace(names["path"], positions=knots)
    end = names["run"].forward([0], [1.0], paths={0: moved}, positions=names["line"][None])
    before, after = (x[..., 1].mean() - names["target"] for x in (names["end"], end))
    assert abs(after) < abs(before)
