"""`warp-deform gradcheck`: its rows are right, and wrong derivatives would show in them."""

import json
import re
import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from warp_deform.cli import main
from warp_deform.differentiable import DifferentiableRollout, Gradients
from warp_deform.errors import InputError
from warp_deform.gradcheck import GradcheckConfig, Row, check
from warp_deform.gradcheck.differences import WORLDS
from warp_deform.gradcheck.draws import draw_states
from warp_deform.rollout import rollout
from warp_deform.worlds import Worlds

LINE = "cable-line-notarget"
FEW = GradcheckConfig(levels=("substep",), states=4)
PARAMETERS = {
    "positions", "velocities", "inverse_masses", "way_points", "knot_times", "damping",
    "table_friction", "contact_friction", "stiffness",
}  # fmt: skip


def overall(rows: list[Row]) -> dict[str, Row]:
    return {row.parameter: row for row in rows if row.constraint == "all"}


@pytest.mark.parametrize("task", [LINE, "fabric-flat"])
def test_substeps_of_real_episodes_agree(task: str) -> None:
    rows, notes = check(task, FEW)
    assert not notes
    found = overall(rows)
    assert set(found) == PARAMETERS
    for row in found.values():
        assert row.task == task and row.level == "substep" and row.dtype == "float64"
        assert row.relative_error is not None and row.relative_error < 1e-4, row
        assert row.cosine is None or row.cosine > 0.9999
        assert row.share >= 0.5
    assert found["positions"].n == 8 and found["stiffness"].n == 4
    assert {"stretch", "grip", "table"} <= {row.constraint for row in rows}


def test_a_wrong_derivative_shows(monkeypatch: pytest.MonkeyPatch) -> None:
    right = DifferentiableRollout.backward

    def wrong(self: DifferentiableRollout, *cotangents: np.ndarray) -> Gradients:
        gradients = right(self, *cotangents)
        return replace(gradients, velocities=1.01 * gradients.velocities)

    monkeypatch.setattr(DifferentiableRollout, "backward", wrong)
    found = overall(check(LINE, FEW)[0])
    error = found["velocities"].relative_error
    assert error is not None and error > 1e-3
    assert found["positions"].relative_error < 1e-4


def test_windows() -> None:
    rows, _ = check(LINE, GradcheckConfig(levels=("window",), windows=2))
    found = overall(rows)
    assert set(found) == PARAMETERS and len(rows) == len(found)
    assert all(0.0 <= row.share <= 1.0 for row in rows)
    assert found["velocities"].growth is None and found["positions"].growth > 0


def test_drawn_states_go_on_as_the_action_does() -> None:
    worlds = Worlds(LINE, WORLDS, lanes=1, precision="float64")
    dt = worlds.solver.config.dt
    held = 0
    for draw in draw_states(worlds, 8, np.random.default_rng(0), seed=0):
        worlds.restore(0, draw.state)
        start = worlds.solver.particle_q(0)
        paths = {} if draw.path is None else {0: draw.path}
        rollout(worlds.solver, [0], paths=paths, least=1e3, most=dt)
        moved = np.linalg.norm(worlds.solver.particle_q(0) - start, axis=1).max()
        assert moved < 1.1 * dt, "nothing is faster than an unloaded tip, 1 m/s"
        held += draw.path is not None
    assert held > 0


def test_bodies_without_derivatives_are_named_or_noted() -> None:
    with pytest.raises(InputError, match="block-notarget has no derivatives to check"):
        check("block-notarget", FEW)


def test_the_command(capsys: pytest.CaptureFixture[str]) -> None:
    few = ["--levels", "substep", "--states", "2", "--json"]
    assert main(["gradcheck", LINE, *few]) == 0
    found = json.loads(capsys.readouterr().out)
    keys = ["task", "level", "constraint", "parameter", "relative_error", "cosine", "share"]
    assert list(found["rows"][0]) == [*keys, "growth", "dtype", "n"]
    assert main(["gradcheck", "cable-lin", *few]) == 2
    assert main(["gradcheck", LINE, "--states", "0"]) == 2
    assert "--states is 0" in capsys.readouterr().err


def test_the_example_of_the_docs_runs(tmp_path: Path) -> None:
    """Its descent, clipped to 2 mm a knot, brings the cable nearer to where the docs want it."""
    page = Path(__file__).resolve().parent.parent / "docs" / "gradients.md"
    (code,) = re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)
    program = tmp_path / "example.py"
    program.write_text(code)
    names = runpy.run_path(str(program))
    slope = names["gradients"].way_points[0]
    assert np.isfinite(slope).all() and slope[3, 1] < 0

    knots = names["knots"] - 2e-3 * slope / np.abs(slope).max() * [[0], [1], [1], [1]]
    moved = replace(names["path"], positions=knots)
    end = names["run"].forward([0], [1.0], paths={0: moved}, positions=names["line"][None])
    before, after = (x[..., 1].mean() - names["target"] for x in (names["end"], end))
    assert abs(after) < abs(before)
