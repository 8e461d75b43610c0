"""Bag tasks: starts, state vectors, scores, stages, what is inside a bag, and tethers."""

from __future__ import annotations

import numpy as np
import pytest
from fixtures.bag_episodes import REACH, delivered, each_items, snapshot, start

from warp_deform.objects import BagConfig, Box
from warp_deform.objects.bag import bag_shell
from warp_deform.rendering.pixels import BOUNDS, SHAPE, TABLE_GRID
from warp_deform.robots.primitive import Outcome
from warp_deform.rollout import GripPath, rollout
from warp_deform.tasks.bag_alone_open import BagAloneOpen
from warp_deform.tasks.bag_color_goal import COLORS, BagColorGoal
from warp_deform.tasks.bag_items import BagItems1, BagItems2
from warp_deform.tasks.bag_opening import enclosed
from warp_deform.tasks.bag_physics import CARRY, INSERT, OPEN
from warp_deform.tasks.free_space import FreeSpace, NoFreeSpace
from warp_deform.tasks.task import Layout, Snapshot
from warp_deform.worlds import Worlds

pytestmark = pytest.mark.in_a_row("bags")

BAGS = (BagAloneOpen, BagItems1, BagItems2, BagColorGoal)
SHELL = bag_shell(BagConfig())
each = pytest.mark.parametrize("cls", BAGS)


# -- starts


@each_items
def test_zone_bag_and_items_start_apart_and_within_reach(cls) -> None:
    for seed in range(60):
        task, layout = start(cls, seed)
        bag = layout.particle_q[:, :2].mean(axis=0)
        items = layout.body_q[:, :2]
        assert len(items) == len(task.cubes)
        (x0, x1), (y0, y1) = BOUNDS[:2]
        assert (items >= (x0, y0)).all() and (items <= (x1, y1)).all()
        assert REACH.contains(np.vstack([items, layout.frame[:2]])).all()
        assert REACH.contains(layout.targets.mean(axis=0))
        half = np.array([layout.configs[k + 1].parts[0].size[2] / 2 for k in range(len(items))])
        assert layout.body_q[:, 2] == pytest.approx(half)
        clear = 0.01  # [m] for what a pixel rounds, and the tilt of the bag
        assert np.linalg.norm(items - bag, axis=1).min() > task.bag.radius - clear
        assert np.linalg.norm(bag - layout.frame[:2]) > 0.13
        assert not task._in_zone(layout, layout.body_q[:, :3]).any()
        if len(items) == 2:
            assert np.linalg.norm(items[0] - items[1]) > 0.035


@each
def test_a_bag_is_dropped_with_its_opening_up_and_one_push_of_a_bead(cls) -> None:
    for seed in range(30):
        task, layout = start(cls, seed)
        bags = layout.particle_q.reshape(-1, len(SHELL.vertices), 3)
        assert len(layout.pushes) == len(bags) == task.objects.count("bag")
        for number, (points, push) in enumerate(zip(bags, layout.pushes, strict=True)):
            assert points[:, 2].min() > 0.0
            assert points[SHELL.ring, 2].mean() > points[0, 2]  # above the pole
            assert push.particle - number * len(points) in SHELL.ring
            assert push.acceleration[2] > 0


@each
def test_an_arm_that_reaches_nothing_is_a_typed_error(cls) -> None:
    with pytest.raises(NoFreeSpace):
        cls().sample(np.random.default_rng(0), FreeSpace((0.0, 0.2)))


def test_the_two_boxes_differ_by_episode_and_in_the_solver() -> None:
    side = Worlds(BagItems2(), 2)
    side.reset({0: 3, 1: 4})
    sizes = {}
    for slot in range(2):
        task_boxes = [o for o in side.episodes[slot].objects if isinstance(o, Box)]
        sizes[slot] = np.array([box.config.parts[0].size for box in task_boxes])
        assert sizes[slot][:, :2].sum(axis=1) == pytest.approx(0.07)
        data = side.solver.data
        group, lane = divmod(int(data.slot[slot]), data.lanes)
        owner = data.topologies[data.group_topology[group]].shape_body
        first = int(data.views["group.shape_start"][group]) + lane * len(owner)
        half = data.views["shapes.half"][first : first + len(owner)]
        rows = [int(np.flatnonzero(owner == box.body)[0]) for box in task_boxes]
        np.testing.assert_allclose(half[rows], sizes[slot] / 2, rtol=1e-6)
    assert not np.allclose(sizes[0], sizes[1])


def test_the_bags_of_a_start_differ_in_colour() -> None:
    seen = set()
    for seed in range(40):
        _, layout = start(BagColorGoal, seed)
        first, other = layout.configs[0].color, layout.configs[2].color
        assert first != other and {first, other} <= set(COLORS)
        assert COLORS[int(layout.targets[0, 2])] == first
        seen.add(first)
    assert seen == set(COLORS)


def test_a_goal_from_elsewhere_keeps_its_bag_and_colour() -> None:
    task, layout = start(BagColorGoal, 7)
    goal = task.goal_targets(layout, snapshot(task, layout))
    np.testing.assert_allclose(goal[0], layout.targets[0])
    for seed in range(20):
        mine = task.sample_for_goal(np.random.default_rng(seed), REACH, goal)
        np.testing.assert_array_equal(mine.targets, goal)
        assert mine.configs[0].color == layout.configs[0].color != mine.configs[2].color
        middle = mine.particle_q[: len(SHELL.vertices), :2].mean(axis=0)
        assert np.linalg.norm(middle - goal[0, :2]) < 0.03


# -- states and scores


@pytest.mark.parametrize(("cls", "size"), list(zip(BAGS, (99, 105, 108, 414), strict=True)))
def test_ground_truth_has_the_sizes_of_the_paper(cls, size: int) -> None:
    task, layout = start(cls)
    rows = task.ground_truth(layout, snapshot(task, layout))
    assert rows.shape == (size,) == (task.ground_truth_size,)
    assert rows.dtype == np.float32 and np.isfinite(rows).all()


@each_items
def test_only_a_carry_scores(cls) -> None:
    task, layout = start(cls, 2)
    for lifts in ((), (OPEN.lift,), (INSERT.lift,), (CARRY.lift, OPEN.lift)):
        state = delivered(task, layout, lifts)
        assert task.score(layout, state) == 0.0 and not task.solved(layout, state)
    for lifts in ((CARRY.lift,), (OPEN.lift, INSERT.lift, CARRY.lift)):
        state = delivered(task, layout, lifts)
        assert task.score(layout, state) == 1.0 and task.solved(layout, state)


@each_items
def test_solved_needs_every_item_and_a_bead_in_the_zone(cls) -> None:
    task, layout = start(cls, 2)
    x, y, yaw = layout.frame
    done = delivered(task, layout, (CARRY.lift,))
    for item in range(len(task.cubes)):
        body_q = done.body_q.copy()
        body_q[item, :2] += [0.2 * np.cos(yaw), 0.2 * np.sin(yaw)]
        state = snapshot(task, layout, done.particle_q, body_q, (CARRY.lift,))
        assert not task.solved(layout, state)
        assert task.score(layout, state) == pytest.approx(1.0 - 0.5 / len(task.cubes))
    away = done.particle_q + np.float32([0.5, 0.0, 0.0])
    state = snapshot(task, layout, away, done.body_q, (CARRY.lift,))
    assert not task.solved(layout, state) and task.score(layout, state) == 0.5
    away[SHELL.ring[0]] = [x, y, 0.01]
    state = snapshot(task, layout, away, done.body_q, (CARRY.lift,))
    assert task.solved(layout, state) and task.score(layout, state) == 0.5 + 0.5 / 32


def test_the_opening_of_a_standing_bag_counts_as_solved() -> None:
    task, layout = start(BagAloneOpen)
    open_bag = task.upright(0.5, 0.0)
    assert task.score(layout, snapshot(task, layout, open_bag)) == pytest.approx(1.0, abs=0.01)
    ring, half = list(SHELL.ring), open_bag.copy()
    half[ring, 0] = 0.5 + 0.5 * (half[ring, 0] - 0.5)
    state = snapshot(task, layout, half)
    assert task.score(layout, state) == pytest.approx(0.5, abs=0.01)
    assert not task.solved(layout, state)


def test_what_is_in_a_standing_bag_is_enclosed() -> None:
    faces = SHELL.faces
    for inside in ([0.0, 0.0, -0.05], [0.03, 0.02, 0.0], [0.0, -0.06, 0.0]):
        assert enclosed(np.array(inside), SHELL.vertices, faces) == 1.0
    assert enclosed(np.array([0.2, 0.0, -0.08]), SHELL.vertices, faces) < 0.4
    assert enclosed(np.array([0.0, 0.0, -0.12]), SHELL.vertices, faces) == 0.0


# -- stages


@each_items
def test_an_item_is_inserted_then_the_bag_is_carried_and_so_on(cls) -> None:
    task, layout = start(cls)
    state = snapshot(task, layout)
    bag, items = state.segments[1], state.segments[2:]
    assert task.privileged_stage(bag.start, state, None) is OPEN
    assert task.privileged_stage(bag.start, state, OPEN) is OPEN
    for ids in items:
        for previous in (None, OPEN, INSERT, CARRY):
            assert task.privileged_stage(ids.start, state, previous) is INSERT
    for other in (0, bag.start, bag.stop - 1):
        assert task.privileged_stage(other, state, INSERT) is CARRY
        assert task.privileged_stage(other, state, CARRY) is CARRY  # it stays with carrying


def test_color_goal_inserts_the_block_and_opens_else() -> None:
    task, layout = start(BagColorGoal)
    state = snapshot(task, layout)
    target, block, other = state.segments
    for previous in (None, OPEN, INSERT):
        assert task.privileged_stage(block.start, state, previous) is INSERT
        for ids in (target, other):
            assert task.privileged_stage(ids.start, state, previous) is OPEN


def color_goal_with_opening(width: float, actions: int) -> tuple[BagColorGoal, Layout, Snapshot]:
    """The target bag with its opening squeezed to a share `width`, after pulls."""
    task, layout = start(BagColorGoal, 3)
    x, y = layout.targets[0, :2]
    points, bag = layout.particle_q.copy(), task.upright(x, y)
    bag[:, 0] = x + width * (bag[:, 0] - x)
    points[: len(bag)] = bag
    return task, layout, snapshot(task, layout, points, lifts=(OPEN.lift,) * actions)


@pytest.mark.parametrize("name", ["demonstrate", "demonstrate_visible"])
def test_a_demonstrator_puts_the_block_in_as_soon_as_it_fits(name) -> None:
    """It goes by what pictures show: the same at every action, or no policy could learn it."""

    def insertions(width: float) -> list[bool]:
        stages = []
        for actions in range(BagColorGoal.max_actions):
            task, layout, state = color_goal_with_opening(width, actions)
            action = getattr(task, name)(layout, state, np.random.default_rng(0))
            stages.append(task.stage_of(float(action[6])) is INSERT)
        return stages

    assert all(insertions(1.0))
    assert all(insertions(0.6))  # no 10 cm, but more than the block's diagonal
    assert not any(insertions(0.2))  # the block does not fit


def test_the_block_is_put_where_the_opening_has_most_room() -> None:
    task, layout, state = color_goal_with_opening(0.6, 7)
    action = task.demonstrate(layout, state, np.random.default_rng(0))
    assert np.linalg.norm(action[3:5] - layout.targets[0, :2]) < 0.03
    offered = task.candidates(layout, state, np.random.default_rng(0), 8)
    assert [task.stage_of(float(a[6])) for a in offered] == [INSERT] * 4 + [OPEN] * 4


# -- simulated


def test_a_bag_lifted_by_one_bead_stays_within_its_tether() -> None:
    side = Worlds(BagAloneOpen(), 1)
    side.reset({0: 1})
    bead = side.objects[0].ring[5]
    lying = side.episodes[0].snapshot.particle_q[bead].astype(float)
    times, knots = (
        np.array([0.0, 0.8, 1.2]),
        lying + np.array([[0, 0, 0], [0, 0, 0.4], [0, 0, 0.4]]),
    )
    run = rollout(
        side.solver,
        [0],
        paths={0: GripPath(times, knots, particle=bead)},
        max_seconds=1.2,
        record=0.05,
    )[0]
    tether = side.solver.data.lane("particles.tether", 0)
    particles = np.array(run.frames.particle_q, dtype=float)
    away = np.linalg.norm(particles - particles[:, [bead]], axis=2)
    assert particles[-1, bead, 2] > lying[2] + 0.35  # it was lifted
    assert tether.max() < 1.0 and (away <= tether * (1 + 1e-3) + 1e-4).all()


def test_no_pull_ends_out_of_view() -> None:
    """A place that no picture shows cannot be learnt, and training refuses such demonstrations."""
    task, layout = start(BagAloneOpen)
    lying = snapshot(task, layout)
    for bead in range(0, 32, 4):
        far = task.pull_bead(layout, lying, bead, overshoot=0.8)
        pixel = TABLE_GRID.to_pixel(far[3:5])
        assert ((pixel >= 0) & (pixel < SHAPE)).all()
        assert (far[3:5] != task.pull_bead(layout, lying, bead, overshoot=0.9)[3:5]).sum() <= 1


def test_a_block_that_lies_on_a_bag_is_not_pressed_through_it() -> None:
    """A policy put the block on a bag, and then took it with the lift of an opening, 5 cm."""
    worlds = Worlds(BagColorGoal(), 1)
    worlds.reset({0: 50_009})
    for x, y, to_x, to_y, lift in (
        (0.3390625, 0.0015625, 0.4078125, -0.0109375, INSERT.lift),
        (0.3515625, 0.0265625, 0.5765625, 0.2140625, INSERT.lift),
        (0.6515625, 0.1578125, 0.4953125, 0.2953125, OPEN.lift),
        (0.4515625, 0.2703125, 0.6203125, 0.2453125, OPEN.lift),
        (0.3890625, 0.2515625, 0.5703125, 0.2390625, INSERT.lift),
        (0.5453125, 0.2453125, 0.5703125, 0.2453125, OPEN.lift),
    ):
        before = worlds.episodes[0].snapshot.body_q[0, 2]
        worlds.step({0: np.array([x, y, 0.0, to_x, to_y, 0.0, lift])})
    episode = worlds.episodes[0]
    past = episode.history[-1]
    assert before > OPEN.lift and isinstance(episode.objects[past.held], Box)
    assert past.outcome is Outcome.PLACED and episode.physics_ok
