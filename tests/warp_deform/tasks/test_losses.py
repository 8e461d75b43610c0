"""Losses of the tasks: smooth, with the right slopes, and least where the task is done."""

import numpy as np
import pytest
import torch

from warp_deform.tasks.losses import cover_distance, grid_maps, mean_distance, ring_area
from warp_deform.tasks.registry import TASKS
from warp_deform.tasks.registry import task as find_task
from warp_deform.worlds import Worlds


def _tensors(snapshot):
    return [
        torch.tensor(np.asarray(a, dtype=float), requires_grad=True)
        for a in (snapshot.particle_q, snapshot.body_q)
    ]


@pytest.mark.parametrize("name", TASKS)
def test_every_task_has_a_loss_with_the_slopes_of_finite_differences(name):
    worlds = Worlds(name, 1)
    worlds.reset({0: 7})
    episode = worlds.episodes[0]
    x, q = _tensors(episode.snapshot)

    def loss(x, q):
        return worlds.task.loss(episode.layout, episode.snapshot, x, q)

    value = loss(x, q)
    assert value.shape == () and torch.isfinite(value)
    slopes = torch.autograd.grad(value, [x, q], allow_unused=True)
    rng = np.random.default_rng(0)
    seen = 0.0
    for _ in range(4):
        ways = [torch.tensor(rng.normal(size=t.shape)) for t in (x, q)]
        by_slopes = sum(
            float((g * w).sum()) for g, w in zip(slopes, ways, strict=True) if g is not None
        )
        eps = 1e-7
        ends = [loss(x + s * eps * ways[0], q + s * eps * ways[1]) for s in (1, -1)]
        measured = (ends[0] - ends[1]).item() / (2 * eps)
        assert by_slopes == pytest.approx(measured, rel=1e-4, abs=1e-6)
        seen = max(seen, abs(by_slopes))
    assert seen > 1e-3, "the state matters"


GOALS = [name for name in TASKS if find_task(name).goal_conditioned and "bag" not in name]


@pytest.mark.parametrize("name", GOALS)
def test_the_loss_is_least_at_the_goal(name):
    worlds = Worlds(name, 1)
    worlds.reset({0: 7})
    episode = worlds.episodes[0]
    start = worlds.task.loss(episode.layout, episode.snapshot, *_tensors(episode.snapshot))
    done = worlds.task.goal_layout(episode.layout)
    x, q = torch.tensor(done.particle_q), torch.tensor(done.body_q)
    assert worlds.task.loss(episode.layout, episode.snapshot, x, q) < 0.01 < start


def test_mean_distance_takes_the_best_map():
    points = torch.tensor([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]], dtype=torch.float64)
    maps = np.array([[0, 1, 2], [2, 1, 0]])
    backwards = np.add(points.numpy()[::-1], [0.0, 0.1])
    assert float(mean_distance(points, backwards, maps)) == pytest.approx(0.1, abs=1e-6)


def test_the_area_of_a_circle_of_beads():
    angles = 2 * np.pi * np.arange(64) / 64
    beads = torch.tensor(0.1 * np.column_stack([np.cos(angles), np.sin(angles)]))
    assert float(ring_area(beads)) == pytest.approx(32 * np.sin(2 * np.pi / 64) * 0.01)
    assert float(ring_area(beads.flip(0))) == pytest.approx(float(ring_area(beads)))


def test_a_cover_is_near_where_vertices_are():
    vertices = torch.tensor([[x, y, 0.01] for x in (0.0, 0.1) for y in (0.0, 0.1)])
    near, far = (torch.tensor([[x, 0.0]]) for x in (0.001, 0.5))
    assert cover_distance(vertices, near, 0.002) < 0.002
    assert float(cover_distance(vertices, far, 0.002)) == pytest.approx(0.4, abs=0.01)


def test_maps_of_a_grid_are_its_symmetries():
    square, oblong = grid_maps(3, 3), grid_maps(2, 3)
    assert square.shape == (8, 9) and oblong.shape == (4, 6)
    assert len({tuple(way) for way in square}) == 8 and len({tuple(way) for way in oblong}) == 4
    assert (np.sort(square, axis=1) == np.arange(9)).all()


def test_a_block_in_place_has_a_loss_however_its_quaternion_was_rounded():
    task = find_task("block-notarget")
    worlds = Worlds(task, 1)
    worlds.reset({0: 7})
    episode = worlds.episodes[0]
    done = task.goal_layout(episode.layout).body_q
    for length in (1.0, 1 + 1e-6, 1 - 1e-6):
        pose = torch.tensor(done)
        pose[:, 3:] *= length
        assert task.loss(episode.layout, episode.snapshot, torch.zeros(0, 3), pose) < 2e-4
