"""The knot: what is one, how it comes untied, and that no strand goes through another."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from warp_deform.control import ControlConfig, ControlWorlds, EpisodeProblem
from warp_deform.control.held_cable import CABLE
from warp_deform.control.knots import overhand_knot, untied
from warp_deform.control.unknot import UNTIE, Unknot
from warp_deform.errors import InputError
from warp_deform.xpbd.guards import ProblemKind

FINE = 12
"""Looks a control step of 50 ms: what goes at 2 m/s has come 8 mm, a bead is 14 mm wide."""

FLAT = np.array((
    (4685, -3898, 71), (4657, -3760, 71), (4628, -3621, 71), (4608, -3481, 71),
    (4602, -3340, 71), (4625, -3201, 71), (4697, -3079, 71), (4804, -2987, 71),
    (4929, -2920, 71), (5043, -2863, 132), (5120, -2760, 191), (5178, -2675, 93),
    (5255, -2559, 71), (5382, -2496, 71), (5473, -2388, 71), (5569, -2284, 71),
    (5649, -2167, 71), (5691, -2032, 71), (5629, -1905, 71), (5487, -1896, 71),
    (5351, -1914, 103), (5340, -2023, 192), (5337, -2147, 123), (5247, -2243, 71),
    (5151, -2347, 71), (5069, -2461, 71), (5026, -2596, 71), (5050, -2736, 71),
    (5163, -2821, 71), (5272, -2911, 71), (5387, -2829, 71), (5371, -2688, 71),
    (5350, -2590, 171), (5287, -2464, 170), (5321, -2368, 72), (5411, -2259, 71),
    (5508, -2156, 71), (5551, -2022, 85), (5411, -2038, 71), (5269, -2034, 71),
    (5128, -2042, 71), (4987, -2034, 71), (4847, -2011, 71), (4711, -1972, 71),
    (4582, -1915, 71), (4462, -1841, 71), (4356, -1747, 71), (4270, -1635, 71),
    (4209, -1507, 71), (4169, -1371, 71),
))  # fmt: skip
"""Beads of a knot that lies on the table [0.1 mm]: most are in one plane."""


class Watched(Unknot):
    """The same in steps of a twelfth."""

    control = ControlConfig(rate=20.0 * FINE, max_speed=1.0)
    horizon = 100 * FINE


def apart(beads: np.ndarray, near: int = 6) -> float:
    """Least distance between two links that are `near` or more apart along the chain."""
    at = np.array([0.0, 1 / 3, 2 / 3])[None, :, None]
    points = (beads[:-1, None] + at * np.diff(beads, axis=0)[:, None]).reshape(-1, 3)
    i, j = np.triu_indices(len(points), 3 * near)
    return float(np.sqrt(((points[i] - points[j]) ** 2).sum(axis=1).min()))


def watched(task: Unknot, actions: np.ndarray, seed: int) -> tuple[ControlWorlds, float]:
    """Worlds after actions (T, 4) of 50 ms, and how near strands came on the way, in spacings."""
    control = ControlWorlds(task, 1, action_penalty=0.0)
    control.reset({0: seed})
    least = np.inf
    for action in np.repeat(actions, FINE, axis=0):
        control.lead([0], action[None])
        if not control.worlds.episodes[0].physics_ok:
            break
        least = min(least, apart(control.worlds.solver.particle_q(0)))
    control.worlds.look(0)
    return control, least / control.task.cable.spacing


# -- what a knot is


@settings(derandomize=True, deadline=None, max_examples=20)
@given(st.integers(0, 10_000), st.floats(1.2, 2.5), st.booleans())
def test_an_overhand_knot_is_one_from_every_side(seed: int, loops: float, mirrored: bool) -> None:
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    beads = overhand_knot(80, 0.01, loops) * ([1, 1, -1] if mirrored else [1, 1, 1])
    assert not untied(beads @ turn + rng.normal(0.0, 1e-4, beads.shape))
    assert not untied(beads[::-1])


def test_chains_without_a_knot_are_untied_however_they_lie() -> None:
    knot = overhand_knot(50, 0.01, 1.5)
    # strands lie on each other in one order: neither above nor below in turn
    spiral = knot.copy()
    spiral[:, 2] = 0.01 * np.arange(50)
    angle = np.linspace(0, 6 * np.pi, 60)
    coil = np.column_stack([np.cos(angle), np.sin(angle), 0.1 * angle])
    flat = np.column_stack([knot[:, :2], np.zeros(50)])
    for chain in (spiral, coil, flat, knot[[0, -1]], knot[:3], knot[14:]):
        assert untied(chain) and untied(1e200 * chain)
    assert not untied(1e200 * knot) and not untied(1e-200 * knot) and not untied(knot + 1e3)
    assert not untied(np.concatenate([np.add(knot, [0.3, 0.0, 0.0]), knot])), "one beside the other"


def test_a_knot_whose_beads_lie_in_one_plane_is_one() -> None:
    """What goes through a triangle in whose plane it begins is left to rounding."""
    assert not untied(FLAT / 1e4) and not untied(FLAT[::-1] / 1e4)
    flat = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 2, 0], [0, 2, 0]])
    for chain in (flat, flat * 0, flat[:1], flat[:0]):
        assert untied(chain)
    with pytest.raises(InputError, match="all finite"):
        untied(np.where(FLAT == 71, np.nan, FLAT))
    with pytest.raises(InputError, match="points"):
        untied(flat[:, :2])


def test_beads_start_a_diameter_apart_on_the_table_and_touch_where_they_cross() -> None:
    task = Unknot()
    for seed in range(20):
        layout = task.sample(np.random.default_rng(seed), None)
        links = np.linalg.norm(np.diff(layout.particle_q, axis=0), axis=1) / task.cable.spacing
        assert 0.95 < links.min() and links.max() < 1.0 + 1e-9
        assert layout.particle_q[:, 2].min() == pytest.approx(task.cable.radius)
        assert 0.6 < apart(layout.particle_q) / task.cable.spacing < 1.2
        assert not task.solved(layout, type("", (), {"particle_q": layout.particle_q}))


def test_the_cost_is_its_sources() -> None:
    """Summed link by link as the source does, with its masks."""
    task = Unknot()
    layout = task.sample(np.random.default_rng(0), None)
    rope = layout.particle_q * (0.02 / task.cable.spacing)
    links, middles = np.diff(rope, axis=0), (rope[1:] + rope[:-1]) / 2
    crossings = near = 0.0
    for i in range(len(links)):
        for j in range(len(links)):
            if abs(i - j) > 1:
                away = middles[i] - middles[j]
                volume = abs(away @ np.cross(links[i], links[j]))
                crossings += volume / (away @ away + 0.02**2) ** 1.5 / (4 * np.pi)
                near += max(0.0, 0.04 - np.linalg.norm(away)) ** 2
    state = type("", (), {"particle_q": layout.particle_q, "body_q": layout.body_q})
    assert task.cost(layout, state) == pytest.approx(crossings + 100 * near, abs=1e-4)
    assert 1.9 < crossings < 2.3
    straight = layout.particle_q[:1] + np.arange(50)[:, None] * [0.0, task.cable.spacing, 0.0]
    state.particle_q = straight
    assert task.cost(layout, state) < 1e-6


@pytest.mark.parametrize(
    ("sizes", "said"),
    [
        ((50, 0.0, 1.5), "spacing"), ((50, np.nan, 1.5), "spacing"), ((50, 0.01, 0.5), "loops"),
        ((50, 0.01, -1.5), "loops"), ((10, 0.01, 1.5), "beads"), ((0, 0.01, 1.5), "beads"),
        ((50, 0.01, 10.0), "beads"), ((50.5, 0.01, 1.5), "beads"),
    ],
)  # fmt: skip
def test_a_knot_that_cannot_be_is_refused(sizes: tuple[float, ...], said: str) -> None:
    with pytest.raises(InputError, match=said):
        overhand_knot(*sizes)


# -- how it comes untied


def test_the_plan_unties_every_goal_and_strands_go_round_each_other() -> None:
    problem = EpisodeProblem("unknot", seeds=range(4), worlds=8)
    played = problem.play(range(4), np.stack([UNTIE] * 4))
    assert played.solved.all() and played.returns.min() > 15
    idle = problem.play(range(4), np.zeros((4, 10, 3)))
    assert not idle.solved.any() and idle.returns.max() < 5
    for seed in range(2):
        control, least = watched(Watched(), played.actions[seed], seed)
        assert control.worlds.episodes[0].physics_ok and control.worlds.solved(0)
        assert least > 0.6  # crossing links touch at 0.71


def test_a_tip_that_is_led_at_the_weight_pushes_it_and_does_not_go_through() -> None:
    """Over it, down beside it, and straight across it, from eight sides."""
    task, slots = Watched(), range(8)
    control = ControlWorlds(task, 8, lanes=8, action_penalty=0.0)
    control.reset(dict.fromkeys(slots, 1))
    solver, episodes = control.worlds.solver, control.worlds.episodes
    start = solver.particle_q(0).astype(float)
    held, weight = start[task.held_particle], start[task.heavy]
    angles = np.linspace(0.0, 2 * np.pi, 8, endpoint=False)
    sides = 0.035 * np.column_stack([np.cos(angles), np.sin(angles), 0.0 * angles])
    corners = [weight + sides + [0, 0, 0.05], weight + sides, weight - sides]
    least, pushed, at = np.full(8, np.inf), np.zeros(8), np.tile(held, (8, 1))
    for corner in corners:
        way = np.linalg.norm(corner - at, axis=1).max()
        steps = int(np.ceil(way / 0.3 * 20 * FINE))
        moves = np.column_stack([(corner - at) / steps * 20 * FINE, np.ones(8)])
        for _ in range(steps):
            running = [slot for slot in slots if episodes[slot].physics_ok]
            control.lead(running, moves[running])
            for slot in running:
                beads = solver.particle_q(slot)
                away = np.linalg.norm(beads[task.held_particle] - beads[task.heavy])
                least[slot] = min(least[slot], away)
                if episodes[slot].physics_ok:
                    pushed[slot] = np.linalg.norm((beads[task.heavy] - weight)[:2])
        at = corner
    assert least.min() > 0.5 * task.cable.spacing
    assert (pushed > task.cable.radius).sum() >= 4  # where the cable was not torn before


def test_nothing_but_the_tip_moves_the_weight() -> None:
    actions = np.tile([0.0, 1.0, 0.0, 1.0], (100, 1))
    control, _ = watched(Watched(), actions, seed=0)
    beads = control.worlds.solver.particle_q(0)
    assert not control.worlds.episodes[0].physics_ok  # it was pulled until it tore
    weight = control.worlds.episodes[0].layout.targets[0]
    assert np.linalg.norm((beads[Watched.heavy] - weight)[:2]) < 1e-3


@pytest.mark.parametrize("speed", [0.1, 0.4, 1.0])
@pytest.mark.parametrize("way", [(0.0, 1.0), (1.0, 1.0), (-1.0, 1.0)])
def test_drawn_tight_it_tears_before_strands_go_through(
    way: tuple[float, float], speed: float
) -> None:
    move = np.append(speed * np.array(way) / np.linalg.norm(way), [0.0, 1.0])
    control, least = watched(Watched(), np.tile(move, (100, 1)), seed=0)
    (problem,) = control.worlds.episodes[0].problems
    assert problem.kind is ProblemKind.STRETCH and 1.15 < problem.value < 1.5
    assert not control.worlds.solved(0) and least > 0.4


def test_by_the_physics_of_other_cables_it_would_come_untied_so() -> None:
    """An overlap is undone slowly there, and links may be half as long again."""

    class Soft(Watched):
        solver = CABLE

    control, least = watched(Soft(), np.tile([0.0, 0.4, 0.0, 1.0], (17, 1)), seed=0)
    assert control.worlds.episodes[0].physics_ok and control.worlds.solved(0) and least < 0.4


def test_what_low_and_wild_plans_untie_they_untie_round_the_strands() -> None:
    """Wild and low plans: most tear the cable, and what comes untied did so round the strands."""
    rng = np.random.default_rng(0)
    numbers = rng.normal(0.0, 0.5, (32, 10, 3)) - [0.0, 0.0, 0.4]
    problem = EpisodeProblem("unknot", seeds=range(32), worlds=16)
    played = problem.play(range(32), numbers)
    torn = ~np.isfinite(played.losses)
    assert torn.sum() > 10
    done = np.flatnonzero(played.solved & ~torn)
    assert len(done) >= 2
    for k in done[:3]:
        least = watched(Watched(), played.actions[k], k)[1]
        assert least > 0.45
