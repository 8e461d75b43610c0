"""cable-mask-goal: what it shows, how it is demonstrated, and that learning sees its own grid."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import warp_deform  # noqa: F401  registers the ids
from learning.data.augmentation import RigidTransform, draw_transform, move_actions, move_states
from warp_deform.collecting.recording import observe, record, task_config
from warp_deform.episodes import EpisodeReader, EpisodeWriter
from warp_deform.planning.demonstrators import demonstrator
from warp_deform.rendering.pixels import SHAPE, TABLE_GRID
from warp_deform.rendering.strand_mask import MaskLook, strand_mask
from warp_deform.robots.primitive import Outcome
from warp_deform.tasks.cable_mask_goal import CableMaskGoal
from warp_deform.tasks.chain_shapes import straight_chain
from warp_deform.tasks.metrics import mask_iou
from warp_deform.tasks.registration import env_id
from warp_deform.tasks.registry import FURTHER_TASKS, TASKS
from warp_deform.tasks.registry import task as find_task
from warp_deform.tasks.task import Snapshot
from warp_deform.worlds import Worlds
from warp_deform.worlds.loop import SOLVED, play
from warp_deform.worlds.spaces import action_space, information, observation, observation_space

TASK = CableMaskGoal()
NAME = TASK.name
STRAIGHT = straight_chain(TASK.cable, np.array([0.485, 0.0]), 1.2)


@cache
def worlds(count: int) -> Worlds:
    return Worlds(NAME, count)


def test_it_is_not_of_the_benchmark_but_found_by_name() -> None:
    assert len(TASKS) == 13 and NAME not in TASKS and NAME in FURTHER_TASKS
    assert isinstance(find_task(NAME), CableMaskGoal)
    assert gymnasium.spec(env_id(NAME)).kwargs == {"task": NAME}


# Masks.


def test_a_mask_has_the_chains_width_and_place() -> None:
    mask = TASK.mask(STRAIGHT)
    area = 89 * 0.005 * 0.005 + np.pi * 0.0025**2
    assert mask.sum() * TASK.grid.pixel_size**2 == pytest.approx(area, rel=0.06)
    pixels = TASK.grid.to_pixel(STRAIGHT[:, :2])
    assert mask[tuple(pixels.T)].all()
    centre = TASK.grid.to_world(np.argwhere(mask)).mean(axis=0)
    assert centre == pytest.approx(STRAIGHT[:, :2].mean(axis=0), abs=3e-4)


@settings(derandomize=True, deadline=None, max_examples=30)
@given(dx=st.floats(-0.02, 0.02), dy=st.floats(-0.02, 0.02))
def test_the_overlap_falls_with_the_distance(dx: float, dy: float) -> None:
    moved = STRAIGHT + np.array([dx, dy, 0.0])
    across = abs(-np.sin(1.2) * dx + np.cos(1.2) * dy)
    iou = mask_iou(TASK.mask(moved), TASK.mask(STRAIGHT))
    assert (iou > 0.25) == (across < 0.003) or abs(across - 0.003) < 0.0008


def test_a_look_changes_the_mask_as_it_says() -> None:
    clean = TASK.mask(STRAIGHT)
    np.testing.assert_array_equal(TASK.mask(STRAIGHT, look=MaskLook()), clean)
    wide, thin = (TASK.mask(STRAIGHT, look=MaskLook(width=w)) for w in (1.5, 0.7))
    assert thin.sum() < clean.sum() < wide.sum() and (wide >= clean).all()
    holed = TASK.mask(STRAIGHT, look=MaskLook(holes=20.0))
    assert 0.5 * clean.sum() < holed.sum() < clean.sum() and (holed <= clean).all()
    again = TASK.mask(STRAIGHT, look=MaskLook(holes=20.0))
    np.testing.assert_array_equal(again, holed)
    shifted = TASK.mask(STRAIGHT, look=MaskLook(shift=(3.0, 0.0)))
    np.testing.assert_array_equal(shifted[3:], clean[:-3])
    for seed in range(20):
        look = MaskLook.draw(np.random.default_rng(seed))
        assert mask_iou(TASK.mask(STRAIGHT, look=look), clean) > 0.4


def test_a_chain_out_of_view_gives_an_empty_mask() -> None:
    far = STRAIGHT[:, :2] + 5.0
    assert not strand_mask(far, 0.005, TASK.grid).any()


# The episode.


def test_observations_are_masks_in_the_environments_spaces() -> None:
    side = worlds(1)
    side.reset({0: 3})
    seen = observation(side, 0)
    assert observation_space(TASK).contains(seen)
    assert set(np.unique(seen["color"])) == set(np.unique(seen["goal_color"])) == {0, 255}
    assert (seen["color"] == seen["color"][..., :1]).all() and not seen["height"].any()
    info = information(side, 0, outcome=None)
    assert 0.0 <= info["score"] <= 0.25 and info["ground_truth"].shape == (540,)
    assert set(np.unique(info["segmentation"])) == {1, 4}
    layout = side.episodes[0].layout
    usual = replace(TASK.solver)
    assert layout.physics["table_friction"] != usual.table_friction
    mu = side.solver.data.per_world("group.table_friction", 0)[0]
    assert mu == pytest.approx(layout.physics["table_friction"])


def test_starts_are_in_view_at_rest_and_unsolved_and_goals_are_reached_by_their_own_chain() -> None:
    side = worlds(8)
    side.reset({slot: 40 + slot for slot in range(8)})
    scores = []
    for slot in range(8):
        episode = side.episodes[slot]
        assert episode.physics_ok and not side.solved(slot)
        assert np.abs(episode.snapshot.particle_qd).max() < 0.02
        assert episode.goal is not None and episode.goal.targets.shape == (90, 2)
        scores.append(side.score(slot))
        at_goal = np.column_stack([episode.goal.targets, np.full(90, 0.0025)])
        reached = replace(episode.snapshot, particle_q=at_goal)
        assert TASK.score(episode.layout, reached) == 1.0
        turned = replace(episode.snapshot, particle_q=at_goal[::-1])
        assert TASK.score(episode.layout, turned) > 0.98
    assert np.median(scores) < 0.1


def test_same_seed_same_bits_in_any_company() -> None:
    def play_two(count: int, slots: dict[int, int]) -> list[str]:
        side = worlds(count)
        side.reset(slots)
        slot = next(s for s, seed in slots.items() if seed == 11)
        hashes = [side.hash(slot)]
        for _ in range(2):
            side.step(
                {
                    s: TASK.demonstrate(
                        side.episodes[s].layout, side.episodes[s].snapshot, np.random.default_rng(0)
                    )
                    for s in slots
                }
            )
            hashes.append(side.hash(slot))
        return hashes

    alone = play_two(1, {0: 11})
    assert len(set(alone)) == 3
    assert play_two(8, {0: 5, 3: 11, 6: 7}) == alone


def test_a_saved_state_goes_on_with_its_own_physics() -> None:
    side = worlds(8)
    side.reset({0: 1, 1: 2})
    state = side.state(0)
    action = TASK.demonstrate(
        state.episode.layout, state.episode.snapshot, np.random.default_rng(0)
    )
    side.step({0: action})
    side.restore(1, state)
    side.step({1: action})
    assert side.hash(1) == side.hash(0)


def test_outcomes() -> None:
    side = worlds(1)
    side.reset({0: 4})
    q = side.episodes[0].snapshot.particle_q
    corner = np.array([0.34, -0.29])
    assert np.linalg.norm(q[:, :2] - corner, axis=1).min() > 0.05
    miss = np.array([*corner, 0.0, 0.5, 0.0, 0.0, 0.05])
    before = side.hash(0)
    assert side.step({0: miss})[0].outcome is Outcome.MISSED
    assert np.abs(side.episodes[0].snapshot.particle_q - q).max() < 1e-3
    far = np.array([0.75, 0.5, 0.0, 0.25, -0.5, 0.0, 0.4])
    report = side.step({0: far})[0]
    assert report.outcome in (Outcome.UNREACHABLE, Outcome.MISSED)
    grip = TASK.demonstrate(
        side.episodes[0].layout, side.episodes[0].snapshot, np.random.default_rng(0)
    )
    report = side.step({0: grip}, record=0.1)[0]
    assert report.outcome is Outcome.PLACED and side.hash(0) != before
    assert report.frames is not None and len(report.frames.times) > 20
    assert (np.diff(report.frames.times) > 0).all()


def test_the_demonstrator_solves_most_of_twenty_seeds(tmp_path: Path) -> None:
    side, act = worlds(8), demonstrator("scripted")
    runs = {}
    for slot, run in play(side, range(20), act=act, look=observe):
        runs[run.seed] = run
        if run.seed == 0:
            EpisodeWriter(tmp_path).write(record(side, slot, run, demonstrator="scripted"))
        assert all(action_space().contains(action) for action in run.actions)
        assert not any(end.startswith("physics") for end in [run.ended or ""])
        if sum(run.ended == SOLVED for run in runs.values()) >= 13 and 0 in runs:
            break  # the others could only add to it
    stored = EpisodeReader(tmp_path).read(0)
    assert stored.info.task == NAME and len(stored.steps) == len(runs[0].actions) + 1
    np.testing.assert_array_equal(stored.steps[0].color, runs[0].rows[0].color)
    solved = [run for run in runs.values() if run.ended == SOLVED]
    assert len(solved) >= 13
    assert 3.0 < np.mean([len(run.actions) for run in solved]) < 8.0
    outcomes = [outcome for run in runs.values() for outcome in run.outcomes]
    assert outcomes.count("placed") > 0.9 * len(outcomes)


def test_the_demonstrator_takes_the_farthest_of_five_beads_and_candidates_any() -> None:
    fewer = type("Fewer", (CableMaskGoal,), {"grips": 3})()
    away = STRAIGHT[:, :2].copy()
    away[:, 0] += np.interp(np.arange(90), [0, 30, 89], [0.01, 0.09, 0.01])
    layout = replace(TASK.sample(np.random.default_rng(0), None), targets=away)
    still = np.zeros_like(STRAIGHT), np.zeros((0, 7)), np.zeros((0, 6))
    snapshot = Snapshot(STRAIGHT, *still, (), lambda: None)
    rng = np.random.default_rng(0)
    taken = [task.demonstrate(layout, snapshot, rng) for task in (TASK, fewer)]
    beads = [int(np.argmin(np.linalg.norm(STRAIGHT[:, :2] - a[:2], axis=1))) for a in taken]
    assert beads == [23, 44] and "grips" not in task_config(TASK), "goals do not depend on it"
    first = TASK.candidates(layout, snapshot, rng, 8)[0]
    assert int(np.argmin(np.linalg.norm(STRAIGHT[:, :2] - first[:2], axis=1))) == 30
    assert len(list(TASK.demonstrated_moves(layout, snapshot))) == 5


def test_the_demonstrator_goes_across_the_chain_and_keeps_fingers_off_it() -> None:
    rng = np.random.default_rng(0)
    for seed in range(30):
        layout = TASK.sample(np.random.default_rng(seed), None)
        q = layout.particle_q.copy()
        q[:, 2] = TASK.cable.radius
        action = TASK.action(q[:, :2], layout.targets, int(rng.integers(90)))
        bead = int(np.argmin(np.linalg.norm(q[:, :2] - action[:2], axis=1)))
        tangent = q[bead + 2, :2] - q[bead - 2, :2]
        assert abs(np.sin(np.arctan2(tangent[1], tangent[0]) - action[2])) < 1e-6
        assert action[2] == action[5] and abs(action[2]) <= np.pi / 2
        assert 2 <= bead <= 87
    assert TASK.graspable(STRAIGHT, np.array([*STRAIGHT[40, :2], 1.2, 0, 0, 0, 0.05]))
    assert not TASK.graspable(STRAIGHT, np.array([*STRAIGHT[40, :2], 1.2 + np.pi / 2, 0, 0, 0, 0]))
    assert not TASK.graspable(STRAIGHT, np.array([0.40, 0.0, 0.0, 0, 0, 0, 0.05]))


# Learning.


def test_a_policys_pick_goes_across_the_mask() -> None:
    color = np.repeat(np.where(TASK.mask(STRAIGHT), 255, 0).astype(np.uint8)[..., None], 3, 2)
    yaw = TASK.pick_yaw(color, STRAIGHT[45, :2])
    assert abs(np.sin(yaw - 1.2)) < 0.03
    assert TASK.pick_yaw(np.zeros_like(color), STRAIGHT[45, :2]) == 0.0
    assert find_task("cable-ring").pick_yaw(color, STRAIGHT[45, :2]) == 0.0


def test_augmentation_turns_into_24_copies_on_the_tasks_own_grid() -> None:
    rng = np.random.default_rng(0)
    action = np.array([*STRAIGHT[40, :2], 0.3, *STRAIGHT[60, :2], 0.3, 0.05])
    drawn = [
        draw_transform(action, rng=rng, grid=TASK.grid, copies=TASK.rotated_copies)
        for _ in range(400)
    ]
    parts = {round(t.turn / (2 * np.pi / 24), 6) for t in drawn}
    assert parts <= set(range(24)) and len(parts) > 18
    for transform in drawn[:20]:
        pixels = TASK.grid.fractional(action[None, :2])
        moved = move_actions(action[None], [transform])[0]
        assert TASK.grid.fractional(moved[:2]) == pytest.approx(transform.of_pixels(pixels)[0])
        assert (
            (TASK.grid.to_pixel(moved[:2]) >= 0) & (TASK.grid.to_pixel(moved[:2]) < SHAPE)
        ).all()
    states = np.zeros((2, 540), np.float32)
    assert move_states(CableMaskGoal.ground_truth_rows, states, drawn[:2]).shape == (2, 540)
    assert RigidTransform(0.0, (0.0, 0.0)).grid == TABLE_GRID == find_task("cable-ring").grid
