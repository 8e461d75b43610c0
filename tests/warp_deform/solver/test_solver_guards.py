"""Every guard fires on the fault that it is for, names it, and leaves a file that reproduces it."""

from __future__ import annotations

import json
import re
from pathlib import Path

import newton
import numpy as np
import pytest
from fixtures.solver_scenes import add_particles, finalize, new_builder, positions

from warp_deform.errors import InputError, WarpDeformError
from warp_deform.objects import BoxConfig, CableConfig, add_box, add_cable, cable_line
from warp_deform.rollout import GripPath, rollout
from warp_deform.solver import (
    GuardLimits,
    PhysicsError,
    ProblemKind,
    SolverConfig,
    SolverFusedXPBD,
    replay_bundle,
)

SHORT = CableConfig(beads=8)
FRAME = 1 / 60


def cable_solver(worlds: int = 1, config: SolverConfig | None = None, **options) -> SolverFusedXPBD:
    one = new_builder()
    add_cable(one, SHORT, cable_line(SHORT, (0.4, 0), (0.6, 0)))
    builder = new_builder()
    builder.replicate(one, worlds)
    return SolverFusedXPBD(builder.finalize(device="cpu"), config, **options)


def step_with(solver: SolverFusedXPBD, change) -> newton.State:
    """One frame from the model's state after change(particle_q, particle_qd)."""
    before, after = solver.model.state(), solver.model.state()
    q, qd = before.particle_q.numpy().copy(), before.particle_qd.numpy().copy()
    change(q, qd)
    before.particle_q.assign(q)
    before.particle_qd.assign(qd)
    solver.step(before, after, None, None, FRAME)
    return after


def nan_position(q, qd):
    q[3, 1] = np.nan


def infinite_velocity(q, qd):
    qd[2, 0] = np.inf


def overstretched(q, qd):
    q[4:, 0] += 5.0


def under_the_table(q, qd):
    q[:, 2] -= 0.5


def too_fast(q, qd):
    qd[:, 2] = 40.0


FAULTS = {
    nan_position: ProblemKind.NONFINITE,
    infinite_velocity: ProblemKind.NONFINITE,
    overstretched: ProblemKind.STRETCH,
    under_the_table: ProblemKind.PENETRATION,
    too_fast: ProblemKind.SPEED_CLAMP,
}
HASTY = SolverConfig(limits=GuardLimits(clamped_steps=0))


@pytest.mark.parametrize("fault", FAULTS, ids=lambda f: f.__name__)
def test_a_fault_is_named(fault):
    solver = cable_solver(config=HASTY)
    with pytest.raises(PhysicsError) as caught:
        step_with(solver, fault)
    kinds = {p.kind for p in caught.value.problems}
    assert FAULTS[fault] in kinds
    assert FAULTS[fault].value in str(caught.value)
    assert isinstance(caught.value, WarpDeformError) and caught.value.bundle is None


def test_a_healthy_step_raises_nothing():
    after = step_with(cable_solver(config=HASTY), lambda q, qd: None)
    assert np.isfinite(after.particle_q.numpy()).all()


def test_a_contact_list_that_is_too_short_is_an_error():
    # 40 loose beads in a clump: 780 pairs, room for 40
    rng = np.random.default_rng(0)
    builder = new_builder()
    add_particles(builder, rng.uniform(0, 0.02, (40, 3)), colliding=True)
    solver = finalize(builder, SolverConfig(), pairs_per_particle=1)
    state = solver.model.state()
    with pytest.raises(PhysicsError) as caught:
        solver.step(state, solver.model.state(), None, None, FRAME)
    assert [p.kind for p in caught.value.problems] == [ProblemKind.OVERFLOW]
    assert caught.value.problems[0].value > 100


def test_a_list_that_overflows_is_the_fault_of_the_world_that_filled_it():
    builder = new_builder()
    for _ in range(2):
        world = new_builder()
        rng = np.random.default_rng(1)
        add_particles(world, np.add(rng.uniform(0, 0.01, (60, 3)), (0, 0, 0.1)), colliding=True)
        builder.add_world(world)
    solver = finalize(builder, SolverConfig(), lanes=8, pairs_per_particle=2)
    solver.data.lane("particles.x", 1)[:, 0] = np.arange(60.0)
    overflow = [v.overflow for v in solver.run(20)]
    assert overflow[0] > 0 and overflow[1] == 0


@pytest.mark.parametrize("view", ["bodies.x", "bodies.v", "bodies.q", "bodies.omega"])
def test_a_body_that_is_not_finite_is_noticed(view):
    builder = new_builder()
    add_box(builder, BoxConfig(), (0.5, 0, 0.02))
    solver = SolverFusedXPBD(builder.finalize(device="cpu"))
    solver.data.views[view][0, 1] = np.nan
    kinds = [p.kind for v in solver.run(30) for p in v.problems(0, solver.config.limits)]
    assert ProblemKind.NONFINITE in kinds


def test_a_grip_that_dives_under_the_table_is_noticed():
    solver = cable_solver()
    start = positions(solver)[0]
    knots = np.array([start, [start[0], start[1], -0.05]])
    result = rollout(
        solver, [0], paths={0: GripPath(np.array([0, 0.5]), knots, particle=0)}, max_seconds=0.6
    )
    problems = result[0].watch.problems(0, solver.config.limits)
    assert ProblemKind.PENETRATION in {p.kind for p in problems}


@pytest.mark.parametrize("lanes", [1, 8])
def test_only_the_faulty_world_is_blamed(lanes):
    solver = cable_solver(worlds=5, lanes=lanes)
    with pytest.raises(PhysicsError) as caught:
        step_with(solver, lambda q, qd: q.__setitem__((3 * SHORT.beads + 2, 0), np.nan))
    assert {p.world for p in caught.value.problems} == {3}
    assert "world 3" in str(caught.value)


# -- bundles


@pytest.fixture
def bundle(tmp_path: Path) -> tuple[SolverFusedXPBD, Path]:
    """A solver after a fault in its second launch, and the file that was written."""
    solver = cable_solver(worlds=3, lanes=8, bundles=tmp_path / "faults")
    solver.run(40)
    with pytest.raises(PhysicsError) as caught:
        step_with(solver, overstretched)
    path = caught.value.bundle
    assert (
        path is not None and path.parent == tmp_path / "faults" and str(path) in str(caught.value)
    )
    return solver, path


def test_a_bundle_reproduces_the_very_bits(bundle):
    solver, path = bundle
    after = replay_bundle(path)
    assert set(after) == set(solver.data.views)
    for name, values in solver.data.views.items():
        assert after[name].tobytes() == values.tobytes(), name
    assert replay_bundle(str(path))["watch.stretch"].max() > 1.5


def test_the_same_fault_has_the_same_bundle(bundle, tmp_path):
    _, path = bundle
    again = cable_solver(worlds=3, lanes=8, bundles=tmp_path / "again")
    again.run(40)
    with pytest.raises(PhysicsError) as caught:
        step_with(again, overstretched)
    assert caught.value.bundle.name == path.name


def test_bundles_are_written_with_bodies_and_grips(tmp_path):
    builder = new_builder()
    add_cable(builder, SHORT, cable_line(SHORT, (0.4, 0), (0.6, 0)))
    add_box(builder, BoxConfig(), (0.45, 0.0, 0.06))
    solver = SolverFusedXPBD(builder.finalize(device="cpu"), precision="float64", bundles=tmp_path)
    start = positions(solver)[0]
    path = GripPath(np.array([0, 0.1]), np.array([start, start - [0, 0, 0.1]]), particle=0)
    result = rollout(solver, [0], paths={0: path}, max_seconds=0.2)
    with pytest.raises(PhysicsError) as caught:
        solver.check([result[0].watch])
    after = replay_bundle(caught.value.bundle)
    for name, values in solver.data.views.items():
        assert after[name].tobytes() == values.tobytes(), name


def test_a_world_that_takes_no_part_leaves_no_bundle(tmp_path):
    solver = cable_solver(worlds=2, lanes=8, bundles=tmp_path)
    solver.data.lane("particles.x", 1)[3] = np.nan
    rollout(solver, [0], max_seconds=0.1)
    assert solver.bundle is None and not list(tmp_path.iterdir())
    rollout(solver, [1], max_seconds=0.1)
    assert solver.bundle is not None


def changed_file(path: Path, kind: str) -> None:
    data = bytearray(path.read_bytes())
    if kind == "cut":
        path.write_bytes(data[: len(data) // 2])
    elif kind == "text":
        path.write_text("not a bundle")
    elif kind == "array":
        np.save(path.open("wb"), np.zeros(3))
    elif kind == "empty":
        np.savez(path, other=np.zeros(2))
    else:
        with np.load(path) as file:
            arrays = {name: file[name] for name in file.files}
        header = json.loads(arrays["header"].tobytes())
        if kind == "number":
            arrays["springs.ij"][0] = 10**6
        elif kind == "missing":
            del arrays["particles.x"]
        elif kind == "precision":
            header["precision"] = "float16"
        elif kind == "setting":
            del header["settings"]["dt"]
        arrays["header"] = np.frombuffer(json.dumps(header).encode(), np.uint8)
        np.savez(path, **arrays)


@pytest.mark.parametrize(
    "kind", ["cut", "text", "array", "empty", "number", "missing", "precision", "setting"]
)
def test_a_bad_bundle_is_refused(bundle, kind):
    _, path = bundle
    changed_file(path, kind)
    with pytest.raises(InputError, match=re.escape(path.name)):
        replay_bundle(path)


def test_a_bundle_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(InputError, match="nothing"):
        replay_bundle(tmp_path / "nothing.npz")


# -- bad configurations


@pytest.mark.parametrize(
    "values",
    [
        {"dt": 0.0},
        {"dt": -1e-3},
        {"dt": np.nan},
        {"damping": -1.0},
        {"table_friction": -0.1},
        {"contact_friction": np.nan},
        {"stiffness": 0.0},
        {"recovery": -0.1},
        {"max_speed": 0.0},
        {"calm_speed": -1.0},
        {"margin": 0.0},
        {"rest_speed": 0.0},
        {"rest_seconds": -1.0},
    ],
)
def test_a_bad_configuration_names_its_field(values):
    with pytest.raises(InputError, match=next(iter(values))):
        SolverConfig(**values)


@pytest.mark.parametrize(
    ("options", "says"), [({"lanes": 3}, "lanes"), ({"precision": "half"}, "precision")]
)
def test_bad_options_of_the_solver_are_refused(options, says):
    with pytest.raises(InputError, match=says):
        cable_solver(**options)


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"friction": 1.0}, "friction"),
        ({"damping": -1.0}, "damping"),
        ({"stiffness": 0.0}, "stiffness"),
    ],
)
def test_bad_parameters_of_a_world_are_refused(values, says):
    with pytest.raises(InputError, match=says):
        cable_solver().set_world(0, **values)
