"""Tasks for control: starts, costs of their sources, bits in any company, gradients, cheats."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from warp_deform.control import (
    CONTROL_TASKS,
    ControlConfig,
    ControlWorlds,
    EpisodeProblem,
    HeldProblem,
    SwingProblem,
    optimize,
)
from warp_deform.control.plan_players import FoldPlayer, carry_rows
from warp_deform.control.push_cable import push_actions
from warp_deform.control.registry import control_task
from warp_deform.control.wire import THROUGH
from warp_deform.errors import InputError
from warp_deform.tasks.fabric_shape import fold_over
from warp_deform.tasks.registration import CONTROL_ALONE


class State:
    """A snapshot of nothing but points."""

    def __init__(self, particle_q: np.ndarray, body_q: np.ndarray, objects: tuple = ()) -> None:
        self.particle_q, self.body_q, self.objects = particle_q, body_q, objects


def start(name: str, seed: int = 0):
    """Task and start of a seed, as laid out."""
    task = control_task(name)
    layout = task.sample(np.random.default_rng(seed), None)
    return task, layout, State(layout.particle_q, layout.body_q)


def test_ids_and_tasks_are_the_same() -> None:
    assert set(CONTROL_ALONE) == set(CONTROL_TASKS)


def test_the_cost_of_gather_is_its_sources() -> None:
    task, layout, state = start("gather")
    unit = 0.02 / task.cable.spacing
    rope, boxes = unit * layout.particle_q, unit * layout.body_q[:, :3]
    pairs = sum(np.linalg.norm(boxes[i] - boxes[j]) for i, j in ((0, 1), (1, 2), (0, 2)))
    away = np.linalg.norm(rope[:, None] - boxes, axis=2)
    assert task.cost(layout, state) == pytest.approx(pairs + 0.1 * away.min(axis=0).sum(), abs=1e-4)
    # an end 4 cm too near to a box costs 4, in the source's metres
    state.particle_q = state.particle_q.copy()
    state.particle_q[-1] = layout.body_q[1, :3] + [0.06 / unit, 0.0, 0.0]
    assert task.cost(layout, state) - 100 * 0.04 < pairs + 0.1 * away.min(axis=0).sum()
    assert task.score(layout, state) < 0.02 < 0.3 < task.score(layout, start("gather")[2])


def test_the_cost_of_wire_is_its_sources_and_falls_to_nothing_at_the_target() -> None:
    task, layout, state = start("wire")
    unit = 0.02 / task.cable.spacing
    rope, target = unit * layout.particle_q, unit * layout.targets
    away = np.linalg.norm(rope[:, None] - target, axis=2)
    off = np.linalg.norm(rope[15, :2] - target[15, :2]) - 0.02
    told = away.min(axis=1).mean() + away.min(axis=0).mean() + 5 * off
    assert task.cost(layout, state) == pytest.approx(told, abs=1e-5)
    assert task.cost(layout, State(layout.targets, layout.body_q)) < 3e-4
    raised = layout.targets + np.array([0.0, 0.0, 0.1 / unit])
    high = unit * layout.targets[0, 2] + 0.1 - 0.04
    assert task.cost(layout, State(raised, layout.body_q)) == pytest.approx(0.2 + high, abs=1e-3)


def test_only_a_cable_that_lies_through_the_gap_with_its_middle_is_wired() -> None:
    task, layout, _ = start("wire")
    posts, beads = layout.body_q[:, :2], layout.targets
    gap = posts[1] - posts[0]
    through = (beads[0] - beads[-1])[:2] / np.linalg.norm((beads[0] - beads[-1])[:2])

    def solved(q: np.ndarray) -> bool:
        return task.solved(layout, State(q, layout.body_q))

    def moved(xy: np.ndarray, z: float = 0.0) -> np.ndarray:
        return beads + np.append(xy, z)

    spacing = task.cable.spacing
    assert solved(beads) and not solved(layout.particle_q)
    assert solved(moved(0.3 * gap)) and not solved(moved(0.6 * gap)) and not solved(moved(-gap))
    assert solved(moved(3 * spacing * through)) and not solved(moved(6 * spacing * through))
    assert not solved(moved(np.zeros(2), 0.05)), "over the posts"
    folded = beads.copy()  # into the gap and out again
    folded[16:, :2] = folded[15:1:-1, :2] + 0.01 * gap / np.linalg.norm(gap)
    assert not solved(folded)
    aside = folded.copy()
    aside[:, :2] += 2 * spacing * through
    assert not solved(aside)


def test_a_path_far_to_one_side_wires_the_cable_at_every_goal() -> None:
    """A tip that goes straight through pulls the cable around a post."""
    problem = HeldProblem("wire", seeds=range(4), worlds=8)
    straight = np.linspace([-0.5, -0.5], [1.4, 1.0], 5)
    played = problem.play(range(4), np.stack([THROUGH] * 4))
    assert played.solved.all() and played.scores.min() > 0.9
    assert not problem.play(range(4), np.stack([straight] * 4)).solved.any()
    # what is searched for is the end, and slopes are those of the same loss
    assert problem.evaluate(THROUGH[None, None])[0, 0] == played.losses[0]
    numbers = problem.refined(np.stack([THROUGH] * 4))
    losses, slopes = problem.gradients(numbers[:1], np.arange(1))
    assert losses[0] == pytest.approx(played.losses[0], abs=5e-3) and np.isfinite(slopes).all()


def test_a_plan_that_wires_is_better_than_any_that_lies_near() -> None:
    """The cable lies along the gap at little cost, or through it at whatever cost."""
    problem = HeldProblem("wire", [0], worlds=8)
    draws = np.random.default_rng(0).normal(0.0, 1.5, (16, *problem.shape))
    numbers = np.concatenate([THROUGH[None], draws])
    played, losses = problem.play([0] * 17, numbers), problem.evaluate(numbers[None])[0]
    sound = np.isfinite(losses)
    assert played.solved[0] and (sound & ~played.solved).any()
    assert (losses[sound] == played.losses[sound] + 100.0 * ~played.solved[sound]).all()
    moves = problem.refined(THROUGH[None])
    assert problem.gradients(np.concatenate([moves, 0 * moves]), np.zeros(2, int))[
        0
    ] == pytest.approx([played.losses[0], 100.0 + problem.play([0], 0 * moves).losses[0]], abs=1e-4)


def test_posts_stand_fast_whatever_is_pulled_around_them() -> None:
    control = ControlWorlds("wire", 1, action_penalty=0.0)
    control.reset({0: 0})
    solver, layout = control.worlds.solver, control.worlds.episodes[0].layout
    centre = layout.body_q[:, :2].mean(axis=0)
    around = [centre - [0.12, 0.09], centre, layout.targets[3, :2], [0.62, 0.05]]
    for goal in around:
        for _ in range(40):
            way = goal - control.worlds.episodes[0].tip[:2]
            if np.linalg.norm(way) < 0.01:
                break
            pace = min(0.8, np.linalg.norm(way) / 0.05) / np.linalg.norm(way)
            control.step({0: np.array([*(pace * way), 0.0, 1.0])})
    assert control.worlds.episodes[0].physics_ok
    assert np.abs(solver.body_q(0)[:, :3] - layout.body_q[:, :3]).max() < 1e-6
    # the cable was pulled against a post, and no bead is in one
    beads = solver.particle_q(0)[:, None, :2] - layout.body_q[:, :2]
    outside = np.maximum(np.abs(beads) - 0.0283 / 2, 0.0)
    radius = control_task("wire").cable.radius
    assert 0.5 * radius < np.linalg.norm(outside, axis=2).min() < 2 * radius


@pytest.mark.parametrize("name", ["push-cable", "gather", "wire", "unknot"])
def test_losses_are_batched_and_have_slopes(name: str) -> None:
    task, layout, _ = start(name)
    other = task.sample(np.random.default_rng(1), None)
    rng = np.random.default_rng(2)
    q = torch.tensor(np.stack([layout.particle_q, other.particle_q]))
    q = q + torch.tensor(rng.normal(0, 1e-3, q.shape))
    body_q = torch.tensor(np.stack([layout.body_q, other.body_q]))
    both = task.losses([layout, other], [], q, body_q)
    for k, each in enumerate((layout, other)):
        alone = task.losses([each], [], q[k : k + 1], body_q[k : k + 1])
        assert torch.equal(alone[0], both[k])
    beads = [0, 15, -1]
    part = q[:1, beads].clone().requires_grad_()

    def loss(points: torch.Tensor) -> torch.Tensor:
        moved = q[:1].index_copy(1, torch.tensor([0, 15, q.shape[1] - 1]), points)
        return task.losses([layout], [], moved, body_q[:1])

    assert torch.autograd.gradcheck(loss, part, atol=1e-4)


def test_a_fold_keeps_lengths_and_stacks_layers() -> None:
    sheet = np.zeros((25, 3))
    sheet[:, 0], sheet[:, 1] = (
        np.tile(np.linspace(0, 0.2, 5), 5),
        np.repeat(np.linspace(0, 0.2, 5), 5),
    )
    folded = fold_over(sheet, sheet[0], sheet[24], 0.01)
    assert folded[0, :2] == pytest.approx(sheet[24, :2]) and np.array_equal(folded[24], sheet[24])
    twice = fold_over(folded, folded[4], folded[24], 0.01)
    assert twice[4, :2] == pytest.approx(sheet[24, :2], abs=1e-9)
    assert twice[:, 2].max() >= folded[:, 2].max()


def test_pushes_go_where_they_are_told_and_not_faster_than_a_tip() -> None:
    control = control_task("push-cable").control
    ends = np.array([[[0.5, 0.1], [0.6, 0.1]], [[0.4, -0.1], [0.4, 0.05]]])
    moves = push_actions(np.array([0.4, 0.0]), ends, control)
    assert moves.shape == (40, 3) and np.linalg.norm(moves, axis=1).max() <= 1
    way = np.array([0.4, 0.0, 0.0]) + 0.05 * np.cumsum(moves, axis=0)
    assert way[[11, 19, 31, 39], :2] == pytest.approx(ends.reshape(4, 2))
    assert way[9, 2] == pytest.approx(0.05) and way[19, 2] == pytest.approx(0.0, abs=1e-9)


def test_a_carry_ends_above_its_place_empty() -> None:
    control = control_task("fold-fabric-3").control
    tip, begin, end = (
        np.array([[0.5, 0, 0.3]]),
        np.array([[0.4, 0.2, 0.004]]),
        np.array([[0.6, 0.0]]),
    )
    held = []
    for t in range(60):
        row = carry_rows(t, tip, begin, end, control)
        tip = tip + 0.05 * row[:, :3]
        held.append(row[0, 3] > 0)
        if t == 16:
            assert tip[0] == pytest.approx(begin[0], abs=1e-6)
    assert tip[0] == pytest.approx([0.6, 0.0, 0.06], abs=1e-6)
    assert sum(held) == 37 and not held[-1]


def test_lanes_have_the_bits_of_one_a_tip_keeps_its_hold_and_a_pin_stays() -> None:
    alone, both = (ControlWorlds("gather", count, action_penalty=0.0) for count in (1, 2))
    alone.reset({0: 0})
    both.reset({0: 3, 1: 0})
    solver, start = alone.worlds.solver, alone.worlds.score(0)
    pinned, boxes = solver.particle_q(0)[0].copy(), solver.body_q(0).copy()
    move = np.array([-0.7, -0.5, 0.0, -1.0])
    for _ in range(9):
        done = alone.step({0: move})[0]
        both.step({0: -0.5 * move, 1: move})
    assert both.worlds.hash(1) == alone.worlds.hash(0) != both.worlds.hash(0)
    assert np.array_equal(solver.particle_q(0)[0], pinned) and alone.holding(0)
    assert np.abs(solver.body_q(0) - boxes)[:, :2].max() > 0.01 and not done.terminated
    # straight to the boxes is the naive term's worst
    for _ in range(40):
        way = solver.body_q(0)[1, :2] - alone.worlds.episodes[0].tip[:2]
        alone.step({0: np.array([*(0.8 * way / np.linalg.norm(way)), 0.3, -1.0])})
        if np.linalg.norm(way) < 0.04:
            break
    assert alone.worlds.score(0) < 0.1 * start


def test_a_fabric_starts_folded_covers_little_and_a_search_goes_on_from_it_to_the_bit(
    monkeypatch,
) -> None:
    monkeypatch.setattr(CONTROL_TASKS["unfold-fabric-1"], "horizon", 80)
    problem = EpisodeProblem("unfold-fabric-1", [4], worlds=8)
    control, task = problem.control, problem.task
    control.reset({0: 4})
    episode = control.worlds.episodes[0]
    assert task.coverage(episode.layout, episode.snapshot) <= 0.85
    assert not episode.history and not control.holding(0) and not task.solved(
        episode.layout, episode.snapshot
    )  # fmt: skip
    flat = State(episode.layout.targets, episode.layout.body_q, episode.snapshot.objects)
    assert task.coverage(episode.layout, flat) > 0.98 and task.solved(episode.layout, flat)
    # neither beside its place, nor crumpled onto one point, is it spread
    aside = flat.particle_q + np.array([0.05, 0, 0])
    for q in (aside, 0.1 * flat.particle_q + 0.9 * flat.particle_q[:1]):
        assert not task.solved(episode.layout, State(q, flat.body_q, flat.objects))
    played = problem.play([0], np.array([[[3.0, 1, 0]]]))
    alone = ControlWorlds("unfold-fabric-1", 1, action_penalty=0.0)
    alone.reset({0: 4})
    for action in played.actions[0]:
        alone.step({0: action})
    assert alone.steps[0] == 80 and alone.worlds.episodes[0].physics_ok
    assert np.array_equal(alone.worlds.episodes[0].snapshot.particle_q, played.particle_q[0])


def test_a_corner_that_is_drawn_a_little_too_far_smooths_what_a_script_leaves_creased() -> None:
    """The script lays every corner at its place; draws lay them about 5 mm beyond."""
    problem = EpisodeProblem("unfold-fabric-1", [2], worlds=8)
    script = np.tile([0.0, -1.0, 0.0], (1, *problem.shape[:1], 1))
    draws = np.random.default_rng(0).normal(0.0, 1.5, (7, *problem.shape))
    played = problem.play([0] * 8, np.concatenate([script, draws]))
    assert not played.solved[0] and played.solved[1:].any()
    assert played.losses[1:].min() < 0.01 < 0.05 < played.losses[0]
    assert np.isfinite(played.losses).all()


def test_what_has_no_plans_is_said() -> None:
    with pytest.raises(InputError, match="not made for control"):
        EpisodeProblem("cable-ring", [0])
    with pytest.raises(InputError, match="multiple of 8"):
        EpisodeProblem("gather", [0], worlds=3)


# -- gradients of what is held


def test_the_gradients_of_a_held_cable_are_those_of_a_swing() -> None:
    """Another chain of code to the same derivatives: one launch, and a loop of control steps."""
    held = HeldProblem("whip-target", [3, 4], worlds=8)
    swing = SwingProblem("whip-target", [3, 4], worlds=8)
    numbers = swing.refined(np.random.default_rng(0).normal(0, 1, (2, *swing.shape)))
    losses, gradients = held.gradients(numbers, np.arange(2))
    expected, known = swing.gradients(numbers, np.arange(2))
    np.testing.assert_array_equal(losses, expected)
    np.testing.assert_array_equal(held.evaluate(numbers[:, None])[:, 0], expected)
    np.testing.assert_allclose(gradients, known, atol=1e-5 * np.abs(known).max())


def test_the_gradients_of_pushes_are_those_of_their_losses() -> None:
    """By differences over the last steps alone: what comes before makes them chaotic."""
    problem = HeldProblem("push-cable", [10_003], worlds=8)
    rng = np.random.default_rng(0)
    # one whose box still pushes at the end
    plans = problem.refined(rng.normal(0, 0.3, (4, *problem.shape))[3:])
    tried = problem.play([0], plans)
    assert np.isfinite(tried.losses).all() and plans.shape == (1, 120, 3)
    losses, gradients = problem.gradients(plans, np.arange(1))
    assert losses[0] == pytest.approx(tried.losses[0], rel=1e-6)
    for last in (2, 5):
        way = np.zeros_like(plans)
        way[:, -last:] = rng.normal(size=(1, last, 3))
        way *= 3e-3 / np.linalg.norm(way)
        ahead, behind = problem.evaluate(np.stack([plans + way, plans - way], axis=1))[0]
        by_way = float((gradients * way).sum())
        assert by_way != 0.0
        assert (ahead - behind) / 2 == pytest.approx(by_way, rel=0.1)


def test_a_descent_from_pushes_loses_nothing_and_plays_as_it_says() -> None:
    problem = HeldProblem("push-cable", [10_000, 10_001], worlds=8)
    found = optimize(problem, "cem+adam", evaluations=14, population=4, seed=1)
    assert found.gradients > 0 and found.numbers.shape == (2, 120, 3)
    assert (np.diff(found.history, axis=0) <= 0).all()
    np.testing.assert_allclose(problem.play([0, 1], found.numbers).losses, found.losses, rtol=1e-6)
    searched = optimize(problem, "cem", evaluations=8, population=4, seed=1)
    refined = problem.refined(searched.numbers)
    played = [problem.play([0, 1], numbers).losses for numbers in (searched.numbers, refined)]
    np.testing.assert_allclose(*played, rtol=1e-6)


def test_gradients_are_refused_where_there_are_none() -> None:
    with pytest.raises(InputError, match="may take and let go"):
        HeldProblem("fold-fabric-1", [0], worlds=8)
    with pytest.raises(InputError, match="depend on what is seen"):
        HeldProblem("push-cable", [0], worlds=8, player=FoldPlayer(ControlConfig(), 2, 1))


def test_a_bundle_is_the_mean_of_directions_around_a_plan() -> None:
    alone, tight, wide = (
        HeldProblem("push-cable", [0, 1], worlds=8, bundle=bundle, spread=spread)
        for bundle, spread in ((1, 0.1), (3, 0.0), (3, 0.1))
    )
    plans = np.random.default_rng(0).normal(0.0, 0.4, (2, *alone.shape))
    plans[:, :, 2:] -= plans[:, :, :2]  # across the cable
    numbers, goals = alone.refined(plans), np.arange(2)
    losses, gradients = alone.gradients(numbers, goals)
    assert np.abs(gradients).max() > 0
    for problem, same in ((tight, True), (wide, False)):
        bundled_losses, bundled = problem.gradients(numbers, goals)
        assert np.array_equal(bundled_losses, losses)
        assert np.array_equal(problem.gradients(numbers, goals)[1], bundled), "no state stays"
        assert np.allclose(bundled, gradients, rtol=1e-9, atol=0) == same
        sizes, most = (np.linalg.norm(g, axis=(1, 2)) for g in (bundled, gradients))
        assert (sizes <= most * (1 + 1e-12)).all() and np.isfinite(bundled).all()
    with pytest.raises(InputError, match="bundle"):
        HeldProblem("push-cable", [0], worlds=8, bundle=0)
