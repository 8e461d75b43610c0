"""Sheets whose rows and columns are solved directly: as stiff at any resolution, the same bits."""

from dataclasses import replace

import numpy as np
import pytest
from fixtures.cloth_scenes import SMALL, cloth_solver
from fixtures.pinned_sheets import edge_strains, pinned_sheet
from fixtures.solver_scenes import G, finalize, frames, ideal, new_builder

from warp_deform.errors import InputError
from warp_deform.objects import ClothConfig, add_cloth, cloth_sheet
from warp_deform.solver import SolverConfig
from warp_deform.tasks.cloth_physics import CLOTH_SOLVER

LOAD = 0.5  # [kg]


def hung(cloth: ClothConfig) -> np.ndarray:
    """Mean strain of each inner column of a sheet that hangs by its upper row, with `LOAD` below.

    The load is spread along the lower edge, so the particles at its ends carry half of the others'.
    """
    builder = new_builder()
    x = cloth_sheet(cloth, (0.0, 0.0), height=0.0)[:, [0, 2, 1]] + [0.0, 0.0, 1.0]
    add_cloth(builder, cloth, x)
    lower, upper = range(cloth.columns), range(len(x) - cloth.columns, len(x))
    for i in lower:
        share = 0.5 if i in (lower[0], lower[-1]) else 1.0
        builder.particle_mass[i] += share * LOAD / (cloth.columns - 1)
    for i in upper:
        builder.particle_mass[i] = 0.0
    config = ideal(dt=SolverConfig().dt, damping=4.0)
    solver = finalize(builder, config, precision="float32")
    solver.run(2400)
    assert np.abs(solver.particle_qd(0)).max() < 5e-3
    shape = solver.particle_q(0).reshape(cloth.rows, cloth.columns, 3)
    lengths = np.linalg.norm(np.diff(shape, axis=0), axis=2)
    return lengths[:, 1:-1].mean(axis=0) / cloth.spacing - 1.0


def columns_alone(cloth: ClothConfig) -> float:
    """The same of columns that hang by themselves, exactly: the load and what hangs below."""
    weight = cloth.mass * G / cloth.rows / cloth.columns * np.arange(1, cloth.rows)
    pull = LOAD * G / (cloth.columns - 1) + weight
    return float(pull.mean() / (cloth.structural_stiffness * cloth.spacing))


@pytest.mark.parametrize("columns", [9, 17, 33])
def test_columns_stretch_by_their_load(columns: int) -> None:
    bare = ClothConfig(rows=columns, columns=columns, shear_stiffness=0.0, solve="direct")
    np.testing.assert_allclose(hung(bare), columns_alone(bare), rtol=0.02)


def test_the_strain_of_a_sheet_does_not_depend_on_its_resolution() -> None:
    strains = {}
    for solve in ("direct", "gauss-seidel"):
        sheets = [ClothConfig(rows=n, columns=n, solve=solve) for n in (9, 17, 33)]
        # n columns stand on a width of n - 1 spacings, and diagonals spread the load over them
        share = [sheet.columns / (sheet.columns - 1) for sheet in sheets]
        strains[solve] = np.array([hung(sheet).mean() for sheet in sheets]) * share
    assert strains["direct"].max() < 1.05 * strains["direct"].min(), strains
    assert strains["gauss-seidel"].max() > 4.0 * strains["gauss-seidel"].min(), strains


@pytest.mark.parametrize(("rows", "passes"), [(6, 1), (15, 2)])
def test_bits_do_not_depend_on_lanes(rows: int, passes: int) -> None:
    cloth = replace(SMALL, rows=rows, side=0.1, solve="direct", structural_stiffness=50.0)

    def shake(x: np.ndarray, seed: int) -> None:
        x += np.random.default_rng(seed).normal(0, 6e-3, x.shape)

    together, _ = cloth_solver(cloth, height=0.05, worlds=3, config=CLOTH_SOLVER, lanes=4)
    for world in range(3):
        shake(together.data.lane("particles.x", world), world)
    together.run(200)
    assert together.data.topologies[0].passes == passes
    for world in range(3):
        alone, _ = cloth_solver(cloth, height=0.05, config=CLOTH_SOLVER, lanes=1)
        shake(alone.data.lane("particles.x", 0), world)
        alone.run(200)
        assert np.isfinite(alone.particle_q(0)).all()
        assert np.array_equal(alone.particle_q(0), together.particle_q(world))


CORNERS = ((-1, 0), (-1, -1))


def strains(sheet: ClothConfig, seconds: float, *, pins=CORNERS, upright: bool = True):
    """Strains (F, E) of the edges of a sheet that falls into hanging by its pins and swings there,
    in every fourth substep.
    """
    solver = pinned_sheet(sheet, pins, upright=upright)
    return edge_strains(sheet, frames(solver, round(seconds / solver.config.dt), 4))


def test_a_sheet_held_by_two_corners_keeps_its_strain_limit() -> None:
    sheet = ClothConfig(rows=25, columns=25)
    assert strains(replace(sheet, solve="direct"), 1.5).max() < 1.105
    assert strains(sheet, 1.5).max() > 1.3


def test_a_fine_sheet_keeps_its_strain_limit() -> None:
    """When it is caught, after 0.06 s; the whole fall is in `benchmarks/strain_limit.py`."""
    fine = ClothConfig(rows=50, columns=50, solve="direct")
    assert strains(fine, 0.12).max() < 1.105


@pytest.mark.parametrize(
    ("pins", "upright"),
    [
        (((-1, 0),), True),
        (CORNERS, False),
        (((0, 0), (-1, 0)), False),
        (((0, 0), (-1, -1)), False),
    ],
    ids=["one corner", "flat, a row", "flat, a column", "flat, opposite corners"],
)
def test_a_sheet_keeps_its_strain_limit_wherever_it_is_held(pins, upright: bool) -> None:
    sheet = ClothConfig(rows=25, columns=25, solve="direct")
    assert strains(sheet, 0.4, pins=pins, upright=upright).max() < 1.105


@pytest.mark.parametrize("limit", [1.02, 1.05])
def test_a_chain_at_its_limit_loads_its_neighbours_up_to_theirs(limit: float) -> None:
    """Two columns that hang, heavy enough for most springs to go beyond the limit if they could."""
    bare = ClothConfig(rows=12, columns=2, mass=1.0, shear_stiffness=0.0, bend_stiffness=0.0)
    column = replace(bare, longest=limit, solve="direct")
    stretched = strains(column, 1.0)
    assert stretched.max() < limit + 2e-3
    # the upper springs are at their limit, the lowest stretches by what hangs on it
    hangs = stretched[-1][:22].reshape(11, 2)
    assert hangs[-3:].min() > limit - 2e-3
    weight = column.mass * G / 24 / (column.structural_stiffness * column.spacing)
    np.testing.assert_allclose(hangs[0] - 1.0, weight, rtol=0.1)


def test_sheets_are_solved_spring_after_spring_unless_asked() -> None:
    assert ClothConfig().solve == "gauss-seidel"
    with pytest.raises(InputError, match=r"ClothConfig.solve must be one of direct, gauss-seidel"):
        ClothConfig(solve="newton")
