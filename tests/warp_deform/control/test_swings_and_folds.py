"""Swings and folds: goals that can be reached, scores by their sources, scripts that reach them."""

from __future__ import annotations

from types import SimpleNamespace

import newton
import numpy as np
import pytest

from warp_deform.control import CONTROL_TASKS, ControlWorlds
from warp_deform.errors import WarpDeformError
from warp_deform.rendering.pixels import BOUNDS


@pytest.fixture(scope="module")
def whips() -> ControlWorlds:
    return ControlWorlds("whip", 8, lanes=8)


def test_goals_of_swings_are_outcomes_over_the_table_and_the_cable_is_put_back(whips) -> None:
    whips.reset({slot: 30 + slot for slot in range(8)})
    goals = []
    for slot in range(8):
        episode = whips.worlds.episodes[slot]
        goal, links = episode.layout.targets, np.diff(episode.layout.targets, axis=0)
        spacing = whips.task.cable.spacing
        assert np.abs(np.linalg.norm(links, axis=1) / spacing - 1).max() < 0.2
        for k, (low, high) in enumerate(BOUNDS[:2]):
            assert low < goal[:, k].min() and goal[:, k].max() < high
        assert goal[:, 2].min() > 0.004
        straight = whips.worlds.solver.particle_q(slot)
        assert np.ptp(straight[:, 0]) < 1e-4 and np.ptp(straight[:, 1]) > 0.3
        assert whips.holding(slot) and whips.worlds.score(slot) < 0.83
        goals.append(goal)
    assert len({goal.tobytes() for goal in goals}) == 8


def test_the_plan_that_made_a_goal_reaches_it_to_the_bit(whips, monkeypatch) -> None:
    plans: list[np.ndarray] = []
    draw = type(whips.task).plan_to_goal

    def drawn(task, rng):
        plans.append(draw(task, rng))
        return plans[-1]

    monkeypatch.setattr(type(whips.task), "plan_to_goal", drawn)
    whips.reset({3: 77})
    for move in plans[-1]:
        done = whips.step({3: np.append(move, 1.0)})[3]
    episode = whips.worlds.episodes[3]
    assert np.array_equal(episode.snapshot.particle_q, episode.layout.targets.astype(np.float32))
    assert done.success and done.truncated and not done.terminated
    assert whips.worlds.score(3) == pytest.approx(1.0)


def test_a_seed_whose_plans_lead_to_no_goal_is_told(whips, monkeypatch) -> None:
    monkeypatch.setattr(type(whips.task), "is_goal", lambda task, particle_q: False)
    monkeypatch.setattr("warp_deform.control.control_worlds._DRAWS", 2)
    with pytest.raises(WarpDeformError, match="no goal in 2 draws for seed 5"):
        whips.reset({0: 5})
    monkeypatch.undo()
    whips.reset({0: 5})


def test_scores_are_those_of_their_sources() -> None:
    whip, target = CONTROL_TASKS["whip"](), CONTROL_TASKS["whip-target"]()
    rng = np.random.default_rng(0)
    layout = whip.layout_for(whip.sample(rng, None), rng.normal(size=(24, 3)))

    class State:
        particle_q = layout.targets + np.array([0.03, 0.0, -0.04])

    # D: the mean over particles of the root mean square over x, y, z
    rms = np.sqrt((np.array([0.03, 0.0, 0.04]) ** 2).mean())
    assert whip.score(layout, State) == pytest.approx(np.exp(-10 * rms))
    tip = target.layout_for(layout, State.particle_q)
    State.particle_q = State.particle_q + np.array([0.0, 0.02, 0.0])
    assert target.distance(tip, State) == pytest.approx(0.02)
    assert target.score(tip, State) == pytest.approx(target.success_score)


def test_a_script_folds_a_fabric_along_its_diagonal() -> None:
    worlds = ControlWorlds("fold-fabric-1", 1, action_penalty=0.0)
    worlds.reset({0: 4})
    task, episode = worlds.task, worlds.worlds.episodes[0]
    start, goal = (layout[0] for layout in (episode.layout.particle_q, episode.layout.targets))
    assert not worlds.holding(0) and task.away(episode.layout, episode.snapshot) > 0.05
    points = [[*start[:2], 0.01]] * 2
    for u in np.linspace(0, 1, 15):
        xy = start[:2] + u * (goal[:2] - start[:2])
        points.append([*xy, 0.01 + 0.14 * np.sin(np.pi * u)])
    paid, k = 0.0, 0
    for _ in range(task.horizon):
        way = np.array(points[k]) - worlds.targets.asked[0, :3]
        speed = 0.05 if k == 0 else 0.03  # a tip on its way to the fabric may hurry
        way *= min(1.0, speed / max(np.linalg.norm(way), 1e-9))
        done = worlds.step({0: np.append(way / 0.05, 1.0 if 0 < k else -1.0)})[0]
        paid += done.reward
        if np.linalg.norm(points[k] - worlds.targets.asked[0, :3]) < 0.005 and k + 1 < len(points):
            k += 1
        if done.terminated:
            break
    assert done.terminated and done.success and worlds.holding(0)
    assert task.away(episode.layout, worlds.worlds.episodes[0].snapshot) < 0.015
    assert paid > 0.7 and worlds.worlds.episodes[0].physics_ok


@pytest.mark.parametrize("name", ["fold-fabric-1", "fold-fabric-3", "unfold-fabric-1"])
def test_no_fabric_counts_while_it_is_held_up(name: str) -> None:
    task = CONTROL_TASKS[name]()
    (cloth,) = task.add_objects(newton.ModelBuilder())
    layout = task.sample(np.random.default_rng(0), None)
    lying = SimpleNamespace(particle_q=layout.targets.copy(), objects=(cloth,))
    assert task.solved(layout, lying)
    # a corner that is held up over its place; on average the vertices are as near as before
    lying.particle_q[0, 2] += 0.03
    assert task.away(layout, lying) < 0.001 and not task.solved(layout, lying)
