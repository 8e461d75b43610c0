"""Augmentation: pictures, pixels, actions and states move as one."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from learning.data import augmentation
from learning.data.augmentation import (
    RigidTransform,
    draw_transform,
    draw_transforms,
    move_actions,
    move_picture,
    move_points,
    move_states,
)
from warp_deform.errors import InputError
from warp_deform.objects.cable import CableConfig
from warp_deform.rendering.pixels import (
    PIXEL_SIZE,
    SHAPE,
    TABLE_GRID,
    PixelGrid,
    pixel_to_world,
    world_to_pixel,
)
from warp_deform.tasks.block import BlockNotarget
from warp_deform.tasks.ground_truth import pose_rows, row_kinds, yaw_columns
from warp_deform.tasks.registry import TASKS
from warp_deform.tasks.registry import task as find_task
from warp_deform.tasks.target_shapes import sample_shape

ACTION = np.array([0.45, -0.1, 0.0, 0.55, 0.2, 0.7, 0.04])
turns = st.floats(-math.pi, math.pi)
shifts = st.tuples(st.floats(-30, 30), st.floats(-30, 30))


@settings(derandomize=True, deadline=None, max_examples=50)
@given(turns, shifts)
def test_world_and_pixels_move_alike(turn: float, shift: tuple[float, float]) -> None:
    moved = RigidTransform(turn, shift)
    pixels = np.array([[0.0, 0.0], [319.0, 159.0], [100.0, 20.0]])
    expected = pixel_to_world(moved.of_pixels(pixels))
    assert np.abs(move_points(pixel_to_world(pixels)[None], [moved])[0] - expected).max() < 1e-12


@settings(derandomize=True, deadline=None, max_examples=50)
@given(turns, shifts)
def test_a_mark_in_the_picture_goes_where_its_pixel_goes(
    turn: float, shift: tuple[float, float]
) -> None:
    moved = RigidTransform(turn, shift)
    color, height = np.zeros((*SHAPE, 3), np.uint8), np.zeros(SHAPE, np.float32)
    color[149:152, 89:92], height[149:152, 89:92] = 255, 0.1
    new_color, new_height = move_picture(color, height, moved)
    row, column = np.round(moved.of_pixels(np.array([[150, 90]])))[0].astype(int)
    assert (0 <= row < SHAPE[0]) and (0 <= column < SHAPE[1])
    assert (new_color[row, column] == 255).all() and new_height[row, column] == np.float32(0.1)
    assert np.argwhere(new_height).mean(axis=0) == pytest.approx([row, column], abs=1.0)


def test_drawn_transforms_keep_both_pixels_in_view_and_have_the_papers_spread() -> None:
    rng = np.random.default_rng(0)
    middle = np.array([0.5, 0.0, 0.0, 0.5, 0.0, 0.0, 0.04])
    drawn = [draw_transform(middle, rng=rng) for _ in range(2000)]
    assert np.std([t.turn for t in drawn]) == pytest.approx(2 * math.pi / 6, rel=0.05)
    assert np.std([t.shift for t in drawn], axis=0) == pytest.approx(160 / 6, rel=0.05)
    corner = np.array([0.25, -0.5, 0.0, 0.7, 0.45, 0.0, 0.04])
    pixels = world_to_pixel(np.stack([corner[:2], corner[3:5]]))
    for _ in range(100):
        moved = np.round(draw_transform(corner, rng=rng).of_pixels(pixels))
        assert ((moved >= 0) & (moved < SHAPE)).all()


def test_many_are_drawn_like_one_and_each_keeps_its_own_action_in_view() -> None:
    rng = np.random.default_rng(0)
    middle = np.array([0.5, 0.0, 0.0, 0.5, 0.0, 0.0, 0.04])
    corner = np.array([0.25, -0.5, 0.0, 0.7, 0.45, 0.0, 0.04])
    actions = np.tile([middle, corner], (600, 1))
    drawn = draw_transforms(actions, rng=rng)
    free, kept = drawn[::2], drawn[1::2]
    assert np.std([t.turn for t in free]) == pytest.approx(2 * math.pi / 6, rel=0.05)
    assert np.std([t.shift for t in free], axis=0) == pytest.approx(160 / 6, rel=0.05)
    pixels = world_to_pixel(np.stack([corner[:2], corner[3:5]]))
    for each in kept:
        moved = np.round(each.of_pixels(pixels))
        assert ((moved >= 0) & (moved < SHAPE)).all()
    # what is thrown away is thrown away as one by one: few turns leave both corners in view
    one_by_one = [abs(draw_transform(corner, rng=rng).turn) for _ in range(200)]
    assert np.mean([abs(t.turn) for t in kept]) == pytest.approx(np.mean(one_by_one), rel=0.15)
    assert {t.turn for t in draw_transforms(actions[:400], rng=rng, copies=4)} == {
        2 * math.pi * k / 4 for k in range(4)
    }


@settings(derandomize=True, deadline=None, max_examples=30)
@given(turns, shifts)
def test_a_mirror_image_moves_pictures_actions_and_states_alike(
    turn: float, shift: tuple[float, float]
) -> None:
    moved = RigidTransform(turn, shift, mirror=True)
    assert np.linalg.det(moved.matrix()[:, :2]) == pytest.approx(-1.0)
    color, height = np.zeros((*SHAPE, 3), np.uint8), np.zeros(SHAPE, np.float32)
    height[149:152, 89:92] = 0.1
    _, seen = move_picture(color, height, moved)
    row, column = moved.of_pixels(np.array([[150, 90]]))[0]
    assert np.argwhere(seen).mean(axis=0) == pytest.approx([row, column], abs=1.0)
    # A body that turns with the place: its mirror image turns the other way.
    heading = np.array([math.cos(ACTION[5]), math.sin(ACTION[5])])
    places = np.stack([ACTION[3:5], ACTION[3:5] + 0.1 * heading])
    ahead = move_points(places[None], [moved])[0]
    action = move_actions(ACTION[None], [moved])[0]
    assert action[3:5] == pytest.approx(ahead[0]) and action[5] == -ACTION[5]
    state = np.zeros(6, np.float32)
    state[:3] = pose_rows(np.array([*ACTION[3:5], 0.02]), ACTION[5])
    pointed = move_state("block-notarget", state, moved)
    yaw = -15.0 * pointed[2]
    assert np.array([math.cos(yaw), math.sin(yaw)]) == pytest.approx(
        (ahead[1] - ahead[0]) / 0.1, abs=1e-5
    )


def test_targets_that_tell_ends_apart_by_their_turning_sense_are_not_mirrored() -> None:
    """Of the targets of cable-shape, whose order is part of the task, none is another mirrored."""
    rng, cable = np.random.default_rng(0), CableConfig()
    for _ in range(200):
        steps = np.diff(sample_shape(rng, (2, 3, 4), cable.beads).outline(cable), axis=0)
        turned = steps[:-1, 0] * steps[1:, 1] - steps[:-1, 1] * steps[1:, 0]
        assert (turned <= 0).all()
    assert [name for name, task in TASKS.items() if not task.mirrors] == ["cable-shape"]


def test_the_block_is_its_own_mirror_image() -> None:
    """Its arms are of equal length: swapping x and y gives the same parts, seen from above."""
    parts = [np.array([part.offset[:2], part.size[:2]]) for part in BlockNotarget.block.parts]
    seen = {tuple(part.ravel()) for part in parts}
    assert seen == {tuple(part[:, ::-1].ravel()) for part in parts}


def test_where_labels_may_leave_the_picture_no_turn_is_thrown_away() -> None:
    far = np.tile([0.25, -0.5, 0.0, 0.7, 0.45, 0.0, 0.04], (600, 1))
    kept = draw_transforms(far, rng=np.random.default_rng(0))
    free = draw_transforms(far, rng=np.random.default_rng(0), in_view=False)
    assert np.std([t.turn for t in free]) == pytest.approx(2 * math.pi / 6, rel=0.08)
    assert np.std([t.turn for t in kept]) < 0.8 * np.std([t.turn for t in free])


def test_every_second_one_is_mirrored_where_wanted() -> None:
    rng = np.random.default_rng(0)
    drawn = [draw_transform(ACTION, rng=rng, mirror=True).mirror for _ in range(400)]
    assert 160 < sum(drawn) < 240
    assert not any(draw_transform(ACTION, rng=rng).mirror for _ in range(50))


def test_what_fits_no_picture_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(augmentation, "_MOST_DRAWS", 20)
    far = np.array([0.3, -3.0, 0.0, 0.6, 3.0, 0.0, 0.04])
    with pytest.raises(InputError, match="do not fit into one picture"):
        draw_transform(far, rng=np.random.default_rng(0))
    with pytest.raises(InputError, match=r"pick \[0.3, -3.0\].*do not fit into one picture"):
        draw_transforms(np.stack([far, ACTION]), rng=np.random.default_rng(0))


def test_an_action_keeps_its_yaws_and_lift() -> None:
    moved = RigidTransform(0.5, (3.0, -4.0))
    action = move_actions(ACTION[None], [moved])[0]
    assert action[[2, 5, 6]].tolist() == ACTION[[2, 5, 6]].tolist()
    lengths = [np.hypot(*(a[:2] - a[3:5])) for a in (ACTION, action)]
    assert lengths[0] == pytest.approx(lengths[1])
    centre = np.array([0.5, 0.0, 0.0, 0.5, 0.0, 0.0, 0.04])
    shifted = np.array([0.5 + 3 * PIXEL_SIZE, -4 * PIXEL_SIZE])
    assert move_actions(centre[None], [moved])[0, :2] == pytest.approx(shifted)


def test_a_pose_turns_by_the_turn() -> None:
    before = pose_rows(np.array([[0.5, 0.1], [0.4, 0.0]]), np.array([0.2, 3.0])).ravel()
    after = move_state("block-notarget", before, RigidTransform(math.pi / 2, (0.0, 0.0)))
    yaws = np.array([0.2 + math.pi / 2, 3.0 - 1.5 * math.pi])
    expected = pose_rows(np.array([[0.4, 0.0], [0.5, -0.1]]), yaws).ravel()
    assert after == pytest.approx(expected, abs=1e-6)


def move_state(task: str, state: np.ndarray, transform: RigidTransform) -> np.ndarray:
    """One state (D,), moved."""
    return move_states(find_task(task).ground_truth_rows, state[None], [transform])[0]


@pytest.mark.parametrize("name", TASKS)
def test_every_tasks_state_moves_rigidly_and_back(name: str) -> None:
    rng = np.random.default_rng(0)
    state = rng.uniform(0.0, 0.2, TASKS[name].ground_truth_size).astype(np.float32)
    moved = move_state(name, state, RigidTransform(0.7, (0.0, 0.0)))
    assert moved.shape == state.shape and moved.dtype == np.float32
    assert np.abs(moved - state).max() > 0.01
    back = move_state(name, moved, RigidTransform(-0.7, (0.0, 0.0)))
    assert np.abs(back - state).max() < 1e-6
    heights = move_state(name, state, RigidTransform(0.0, (8.0, 0.0))).reshape(-1, 3)
    assert (np.abs(heights - state.reshape(-1, 3)).max(axis=0)[1:] < 1e-6).all()


def test_what_moves_together_moves_as_alone() -> None:
    """Also among mirror images, and with a grid of its own."""
    rng = np.random.default_rng(4)
    fine = PixelGrid((0.3, -0.2), PIXEL_SIZE / 2)
    transforms = [
        RigidTransform(0.7 * i, (3.0 * i, -i), (TABLE_GRID, fine)[i % 2], i > 2) for i in range(6)
    ]
    states = rng.uniform(-0.2, 0.2, (6, TASKS["bag-color-goal"].ground_truth_size))
    states = states.astype(np.float32)
    actions = rng.uniform(-0.3, 0.3, (6, 7))
    together = move_states(TASKS["bag-color-goal"].ground_truth_rows, states, transforms)
    for i, each in enumerate(transforms):
        assert together[i].tolist() == move_state("bag-color-goal", states[i], each).tolist()
    together = move_actions(actions, transforms)
    for i, each in enumerate(transforms):
        assert together[i].tolist() == move_actions(actions[i : i + 1], [each])[0].tolist()
    assert len(np.unique(together, axis=0)) == 6


def test_colours_and_displacements_of_bags_are_not_shifted() -> None:
    state = np.full(414, 0.1, np.float32)
    moved = move_state("bag-color-goal", state, RigidTransform(0.0, (16.0, 0.0))).reshape(-1, 3)
    still = np.flatnonzero(np.abs(moved[:, 0] - 0.1) < 1e-6)
    assert still.tolist() == [32, 65, 67, 68, 101, 134, 136, 137]


def test_yaws_of_bodies_are_found_by_what_a_turn_changes() -> None:
    for task, yaws in (("block-notarget", 2), ("bag-items-2", 3), ("cable-line-notarget", 0)):
        rows = find_task(task).ground_truth_rows
        columns = list(yaw_columns(rows))
        state = np.zeros((1, 3 * len(row_kinds(rows))), np.float32)
        moved = move_states(rows, state, [RigidTransform(turn=0.3, shift=(0.0, 0.0))])
        assert len(columns) == yaws
        assert moved[0, columns] == pytest.approx(-0.3 / 15)
    assert yaw_columns(()) == ()


def test_a_state_of_another_size_is_refused() -> None:
    with pytest.raises(InputError, match="cannot be moved"):
        move_state("cable-ring", np.zeros(9, np.float32), RigidTransform(0.0, (0.0, 0.0)))
