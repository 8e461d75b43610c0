"""The adjoint of rigid bodies against finite differences and closed forms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from fixtures.cloth_scenes import SMALL, cloth_solver
from fixtures.solver_scenes import (
    LOOSE,
    G,
    add_particles,
    box_solver,
    finalize,
    ideal,
    new_builder,
)
from scipy.spatial.transform import Rotation

from warp_deform.objects import BoxConfig, add_box
from warp_deform.rollout import DifferentiableRollout, Gradients, GripPath
from warp_deform.solver import SolverConfig, SolverFusedXPBD
from warp_deform.tasks.cloth_physics import FABRIC_SOLVER

pytestmark = pytest.mark.in_a_row("adjoints")

DT = 1 / 1200
CUBE = BoxConfig(mass=0.05, friction=0.8)
SOLID = SolverConfig(
    damping=1.0, table_friction=0.6, contact_friction=0.7, max_speed=1e3, limits=LOOSE
)
PARAMETERS = ("damping", "table_friction", "contact_friction")


class Check:
    """A rollout of world 0 from its present state, and its loss along random cotangents."""

    def __init__(
        self, solver: SolverFusedXPBD, steps: int = 1, path: GripPath | None = None, seed: int = 0
    ) -> None:
        self.solver, self.steps, self.path = solver, steps, path
        poses, twists = solver.data.body_poses(0)
        self.at: dict[str, np.ndarray] = {"body_poses": poses, "body_velocities": twists}
        if solver.data.has_particles:
            self.at |= {"positions": solver.particle_q(0), "velocities": solver.particle_qd(0)}
            self.at["inverse_masses"] = solver.data.lane("particles.w0", 0).copy()
        for name in PARAMETERS:
            self.at[name] = solver.data.per_world(f"group.{name}", 0).copy()
        self.at["body_inverse_masses"] = solver.data.views["bodies.w0"].copy()
        self.start = {k: v.copy() for k, v in self.at.items()}
        self.rng = np.random.default_rng(seed)
        self.g = {
            "bodies": self.rng.normal(size=poses.shape),
            "body_velocities": self.rng.normal(size=twists.shape) * 1e-2,
        }
        if solver.data.has_particles:
            shape = self.at["positions"].shape
            self.g["positions"] = self.rng.normal(size=shape)
            self.g["velocities"] = self.rng.normal(size=shape) * 1e-2

    def run(self, moved: Mapping[str, np.ndarray] | None = None) -> DifferentiableRollout:
        """Roll out from a moved start; `loss` is that of it."""
        at = self.start | dict(moved or {})
        data = self.solver.data
        for name in ("w0", "w"):
            data.views[f"bodies.{name}"][:] = at["body_inverse_masses"]
        run = DifferentiableRollout(self.solver)
        state = {
            k: at[k][None]
            for k in ("body_poses", "body_velocities", "positions", "velocities")
            if k in at
        }
        parameters = {k: at[k] for k in PARAMETERS}
        if "inverse_masses" in at:
            parameters["inverse_masses"] = at["inverse_masses"][None]
        path = self.path
        if path is not None:
            path = replace(path, positions=at.get("waypoints", path.positions))
            path = replace(path, rotations=at.get("knot_rotations", path.rotations))
        run.forward(
            [0],
            [self.steps * DT],
            paths={} if path is None else {0: path},
            parameters=parameters,
            **state,
        )
        poses, twists = data.body_poses(0)
        assert np.array_equal(run.body_poses[0, 0], poses)
        # the change only: less is lost to rounding
        self.loss = float(
            (self.g["bodies"] * (poses - self.start["body_poses"])).sum()
            + (self.g["body_velocities"] * (twists - self.start["body_velocities"])).sum()
        )
        if "positions" in self.g:
            for name, now in (
                ("positions", self.solver.particle_q(0)),
                ("velocities", self.solver.particle_qd(0)),
            ):
                self.loss += float((self.g[name] * (now - self.start[name])).sum())
        return run

    def along(self, name: str) -> np.ndarray:
        base = self.start[name] if name in self.start else self.knots[name]
        along = self.rng.normal(size=base.shape)
        if name == "body_poses":
            q = base[:, 3:]
            along[:, 3:] -= q * (q * along[:, 3:]).sum(axis=1, keepdims=True)
        return along * (base > 0) if "masses" in name else along

    def errors(self, *, draws: int = 2) -> dict[str, tuple[float, float, float]]:
        """By name: the worst difference of the directional derivatives, its size, and the step."""
        steps = {
            "body_poses": 1e-9, "body_velocities": 1e-7, "positions": 1e-9, "velocities": 1e-7,
            "inverse_masses": 1e-6 * np.max(self.start.get("inverse_masses", 1.0)),
            "body_inverse_masses": 1e-6 * self.start["body_inverse_masses"].max(),
            "damping": 1e-3, "table_friction": 1e-6, "contact_friction": 1e-6,
            "waypoints": 1e-9, "knot_rotations": 1e-9,
        }  # fmt: skip
        ours = self.run().backward(**{k: v[None, None] for k, v in self.g.items()})
        self.counts = ours.counts()
        self.knots = {}
        values = {k: getattr(ours, k)[0] for k in steps if k in self.start}
        if self.path is not None:
            self.knots["waypoints"] = self.path.positions
            values["waypoints"] = ours.waypoints[0]
            if self.path.rotations is not None:
                self.knots["knot_rotations"] = self.path.rotations
                values["knot_rotations"] = ours.knot_rotations[0]
        out: dict[str, tuple[float, float, float]] = {}
        for name, value in values.items():
            base = self.start[name] if name in self.start else self.knots[name]
            for _ in range(draws):
                along, size = self.along(name), steps[name]
                by = float((value * along).sum())
                self.run({name: base + size * along})
                above = self.loss
                self.run({name: base - size * along})
                wrong = abs((above - self.loss) / (2 * size) - by)
                if wrong >= out.get(name, (-1.0,))[0]:
                    out[name] = wrong, abs(by), size
        self.run()
        return out

    def assert_right(self, *, rounding: float = 10.0, draws: int = 2) -> dict[str, int]:
        for name, (wrong, right, size) in self.errors(draws=draws).items():
            assert wrong < 1e-6 * right + rounding * 2e-15 / size, (name, wrong, right)
        return self.counts


def set_twist(solver: SolverFusedXPBD, *twists: tuple[float, ...]) -> None:
    poses, _ = solver.data.body_poses(0)
    solver.data.set_bodies(0, poses, np.array(twists))


def tilted(
    solver: SolverFusedXPBD, turn: tuple[float, float, float], z: float, body: int = 0
) -> None:
    """Turn a body by a rotation vector and put it at height z."""
    poses, twists = solver.data.body_poses(0)
    poses[body, 3:] = Rotation.from_rotvec(turn).as_quat()
    poses[body, 2] = z
    solver.data.set_bodies(0, poses, twists)


def test_free_flight_with_spin() -> None:
    solver = box_solver((BoxConfig(mass=0.05), (0, 0, 0.5)), config=ideal(damping=1.5))
    tilted(solver, (0.4, -0.2, 0.9), 0.5)
    set_twist(solver, (0.3, -0.2, 0.5, 6.0, -9.0, 4.0))
    assert Check(solver, 5).assert_right() == {}


def test_stopping_distance_of_a_sliding_box() -> None:
    """The way v^2 / (2 mu g) has slopes v / (mu g) and -s / mu."""
    mu, speed = 0.4, 0.6
    box = BoxConfig(mass=0.05, friction=1.0)
    solver = box_solver((box, (0, 0, 0.02)), config=ideal(table_friction=mu))
    set_twist(solver, (speed, 0, 0, 0, 0, 0))
    run = DifferentiableRollout(solver)
    run.forward([0], [0.3])
    end = run.body_poses[0, 0, 0, 0]
    gradients = run.backward(bodies=np.array([[[[1.0, 0, 0, 0, 0, 0, 0]]]]))
    assert end == pytest.approx(speed**2 / (2 * mu * G), rel=0.02)
    assert gradients.body_velocities[0, 0, 0] == pytest.approx(speed / (mu * G), rel=0.03)
    assert gradients.table_friction[0] == pytest.approx(-end / mu, rel=0.03)
    assert gradients.body_poses[0, 0, 0] == pytest.approx(1.0, rel=1e-6)


@pytest.mark.parametrize("steps", [1, 4])
def test_a_box_that_falls_slides_and_turns_on_the_table(steps: int) -> None:
    solver = box_solver((CUBE, (0, 0, 0.02)), config=SOLID)
    tilted(solver, (0.02, -0.03, 0.4), 0.0205)
    set_twist(solver, (0.3, -0.1, -0.2, 0.5, 1.0, 3.0))
    counts = Check(solver, steps).assert_right()
    assert counts["body_table"] > 0 and counts["body_slip"] > 0


def carried(release: bool) -> tuple[SolverFusedXPBD, GripPath, int]:
    solver = box_solver((CUBE, (0, 0, 0.0202)), config=SOLID)
    times = np.array([0, 0.002, 0.0052])
    knots = np.array([[0, 0, 0.0202], [1e-3, 5e-4, 0.0212], [2e-3, 0, 0.0193]])
    turns = np.array([[0, 0, 0, 1], [0.01, 0.02, 0.1, 0.99], [0.0, 0.01, 0.2, 0.97]])
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    path = GripPath(
        times,
        knots,
        body=0,
        rotations=turns,
        offset=np.array([0.003, -0.002, 0.001]),
        turn=np.array([0.0, 0.0, 0.6, 0.8]),
    )
    return solver, path, 16 if release else 4


@pytest.mark.parametrize("release", [False, True])
def test_a_box_that_is_carried_and_released(release: bool) -> None:
    solver, path, steps = carried(release)
    counts = Check(solver, steps, path).assert_right(rounding=30.0)
    assert counts.get("release", 0) == release
    assert counts["grip"] == (6 if release else 4)
    assert not release or counts["body_table"] > 0


@pytest.mark.parametrize("last", [1.5, 3.5])
def test_a_descent_that_contact_ends(last: float) -> None:
    """In the only substep of it, or with others left to skip."""
    _, path, _ = carried(False)
    solver = box_solver((CUBE, (0, 0, 0.02005)), config=SOLID)
    counts = Check(solver, 3, replace(path, lower=(0.0, last * DT))).assert_right(rounding=30.0)
    assert counts["reached"] == 1


@pytest.mark.parametrize("turn", [(0.02, 0.01, 0.5), (0.5, 0.6, 0.1)])
def test_a_box_on_a_box(turn: tuple[float, float, float]) -> None:
    solver = box_solver((CUBE, (0, 0, 0.0199)), (CUBE, (0.012, 0.007, 0.06)), config=SOLID)
    tilted(solver, turn, 0.0595 if turn[0] < 0.1 else 0.069, body=1)
    set_twist(solver, (0.05, 0, 0, 0, 0, 0.3), (-0.2, 0.1, -0.5, 0.3, 0.2, -1.0))
    counts = Check(solver, 3).assert_right(rounding=30.0)
    assert counts["body_body"] > 0 and counts["body_table"] > 0


@pytest.mark.parametrize("masses", [(0.05, 0.05, 0.05), (0.05, 0.05, 2.0)])
def test_a_stack_that_is_pressed_and_turned(masses: tuple[float, ...]) -> None:
    """The visits from the table up and back down are the start of the passes over all contacts."""
    boxes = [replace(CUBE, mass=mass) for mass in masses]
    spots = [(0.0, 0.0, 0.0199), (0.004, 0.003, 0.0597), (-0.003, 0.002, 0.0995)]
    solver = box_solver(*zip(boxes, spots, strict=True), config=SOLID)
    for body, turn in enumerate([(0.002, 0.001, 0.3), (-0.001, 0.002, 0.9), (0.001, 0.001, 0.1)]):
        tilted(solver, turn, spots[body][2], body)
    set_twist(
        solver, (0.02, 0, 0, 0, 0, 0.1), (-0.1, 0.05, -0.2, 0, 0, -0.4), (0, 0.1, -0.1, 0, 0, 0)
    )
    counts = Check(solver, 2).assert_right(rounding=30.0)
    assert counts["body_body"] >= 8 and counts["body_table"] > 0


def test_a_box_that_is_pushed_from_the_side() -> None:
    solver = box_solver((CUBE, (0, 0, 0.0199)), (CUBE, (0.0398, 0.006, 0.0199)), config=SOLID)
    tilted(solver, (0.001, 0.002, 0.1), 0.0199)
    tilted(solver, (0.002, -0.001, 0.15), 0.0199, body=1)
    set_twist(solver, (0.4, 0, 0, 0, 0, 0.3), (-0.1, 0.1, 0, 0, 0, -0.2))
    counts = Check(solver, 2).assert_right(rounding=30.0)
    assert counts["body_body"] > 0 and counts["body_table"] > 0


def test_a_free_box_under_a_held_one() -> None:
    """What holds from above carries nothing: it is no support."""
    solver = box_solver((CUBE, (0, 0, 0.0199)), (CUBE, (0.003, 0.002, 0.0597)), config=SOLID)
    tilted(solver, (0.001, 0.002, 0.2), 0.0199)
    path = GripPath(
        np.array([0, 0.01]), np.array([[0.003, 0.002, 0.0597], [0.003, 0.002, 0.0592]]), body=1
    )
    counts = Check(solver, 2, path).assert_right(rounding=30.0)
    assert counts["body_body"] > 0 and counts["grip"] == 2


def test_edges_of_boxes_across_each_other() -> None:
    solver = box_solver((CUBE, (0, 0, 0.03)), (CUBE, (0.0, 0.0, 0.086)), config=SOLID)
    tilted(solver, (np.pi / 4, 0, 0), 0.03)
    tilted(solver, (0, np.pi / 4 + 0.1, 0), 0.0862, body=1)
    set_twist(solver, (0, 0, 0, 0, 0, 0), (0.1, 0.2, -0.6, 0.3, 0.2, -1.0))
    assert Check(solver, 2).assert_right(rounding=30.0)["body_body"] > 0


def beads_and_box(**options: object) -> SolverFusedXPBD:
    builder = new_builder()
    add_box(builder, CUBE, (0, 0, 0.0199))
    beads = [(0.0, 0.01, 0.0445), (0.0243, -0.005, 0.02), (0.0235, 0.022, 0.0049),
             (0.0, 0.0, 0.03), (-0.0225, -0.0225, 0.041)]  # fmt: skip
    add_particles(
        builder, beads, colliding=True, masses=0.01,
        velocities=[(0.1, 0.2, -0.3), (-0.4, 0.1, 0.1), (-0.3, -0.2, 0), (0, 0, 0), (0.5, 0.4, -1)],
    )  # fmt: skip
    return finalize(builder, SOLID, **options)


@pytest.mark.parametrize("steps", [1, 3])
def test_beads_that_push_a_box(steps: int) -> None:
    solver = beads_and_box()
    tilted(solver, (0.01, -0.02, 0.05), 0.0199)
    counts = Check(solver, steps).assert_right(rounding=30.0)
    assert counts["box_particle"] >= 4 * steps and counts["table"] > 0


def test_a_box_pushed_by_a_held_bead() -> None:
    solver = beads_and_box()
    start = solver.particle_q(0)[1]
    path = GripPath(
        np.array([0, 0.01]), start + np.array([[0, 0, 0], [-0.004, 0.001, 0]]), particle=1
    )
    counts = Check(solver, 5, path).assert_right(rounding=100.0)
    assert counts["grip"] == 5 and counts["box_particle"] > 0


def test_a_sheet_draped_on_a_box() -> None:
    config = replace(FABRIC_SOLVER, damping=4.0, limits=LOOSE, sleep_speed=0.0, max_speed=1e3)
    solver, _ = cloth_solver(
        SMALL, box=(0.5, 0.0, 0.0199), config=config, lanes=1, precision="float64"
    )
    tilted(solver, (0.1, -0.07, 0.3), 0.0225)
    x = solver.particle_q(0)
    out = np.maximum(np.linalg.norm(x[:, :2] - [0.5, 0.0], axis=1) - 0.025, 0.0)
    x[:, 2] = 0.0435 - 0.6 * out
    solver.data.lane("particles.x", 0)[:] = x
    noise = np.random.default_rng(0).normal(size=x.shape)
    solver.data.lane("particles.v", 0)[:] = noise * 0.05 - [0, 0, 0.5]
    counts = Check(solver, 2).assert_right(rounding=100.0)
    assert counts["box_triangle"] > 0 and counts["box_particle"] > 0


def test_a_box_that_slides_on_a_sheet_loads_the_table_under_it() -> None:
    config = replace(FABRIC_SOLVER, damping=4.0, limits=LOOSE, sleep_speed=0.0, max_speed=1e3)
    on = (0.5, 0.0, 2 * SMALL.radius + 0.02)
    solver, _ = cloth_solver(SMALL, box=on, config=config, lanes=1, precision="float64")
    tilted(solver, (0.004, -0.003, 0.3), on[2] - 1e-4)
    set_twist(solver, (0.2, 0.1, -0.2, 0.3, 0.1, 0.5))
    rng = np.random.default_rng(0)
    solver.data.lane("particles.x", 0)[:, 2] -= rng.uniform(0, 1e-5, 36)
    solver.data.lane("particles.v", 0)[:] = rng.normal(size=(36, 3)) * 0.02 + [0.1, 0, 0]
    counts = Check(solver, 3).assert_right(rounding=100.0)
    assert counts["box_particle"] >= 4 and counts["box_triangle"] > 0 and counts["table"] >= 36


def test_bits_depend_neither_on_storage_nor_on_lanes() -> None:
    def gradients(lanes: int, storage: str) -> Gradients:
        builder, one = new_builder(), new_builder()
        add_box(one, CUBE, (0, 0, 0.0202))
        add_box(one, CUBE, (0.01, 0, 0.0605))
        builder.replicate(one, lanes)
        solver = finalize(builder, SOLID, lanes=lanes, precision="float32")
        run = DifferentiableRollout(solver, storage=storage)
        world = lanes - 1
        run.forward([world], [0.01, 0.03])
        return run.backward(bodies=np.ones((1, 2, 2, 7)))

    alone, again = gradients(1, "full"), gradients(1, "replay")
    together = gradients(8, "replay")
    for name in ("body_poses", "body_velocities", "body_inverse_masses", "fired"):
        a, b, c = (getattr(g, name) for g in (alone, again, together))
        assert np.array_equal(a, b) and np.array_equal(a, c)
