"""Losses of many worlds at once: each is that of the world alone, with its slopes."""

from __future__ import annotations

from typing import ClassVar

import newton
import numpy as np
import pytest
import torch

from warp_deform.solver import SolverFusedXPBD
from warp_deform.tasks.block import BlockNotarget
from warp_deform.tasks.free_space import FreeSpace
from warp_deform.tasks.registry import TASKS
from warp_deform.tasks.registry import task as find_task
from warp_deform.tasks.task import Snapshot, Task


def drawn(task: Task, seeds: range) -> tuple[list, list, torch.Tensor, torch.Tensor]:
    """Layouts, and states as they were drawn, shaken by 1 cm, before anything has moved."""
    builder = newton.ModelBuilder()
    SolverFusedXPBD.register_custom_attributes(builder)
    objects = task.add_objects(builder)
    layouts = [task.sample(np.random.default_rng(seed), FreeSpace()) for seed in seeds]
    snapshots = [
        Snapshot(l.particle_q, 0 * l.particle_q, l.body_q, l.body_q[:, :6], (), None, objects)
        for l in layouts
    ]
    arrays = (np.stack([getattr(l, part) for l in layouts]) for part in ("particle_q", "body_q"))
    x, q = (torch.tensor(array, dtype=torch.float64) for array in arrays)
    x += 0.01 * torch.randn(x.shape, generator=torch.Generator().manual_seed(0))
    x.requires_grad_()
    q.requires_grad_()
    return layouts, snapshots, x, q


@pytest.mark.parametrize("name", TASKS)
def test_losses_of_worlds_are_those_of_each_alone_to_the_bit(name: str) -> None:
    task = find_task(name)
    layouts, snapshots, x, q = drawn(task, range(3))
    together = task.losses(layouts, snapshots, x, q)
    alone = [task.loss(*world) for world in zip(layouts, snapshots, x, q, strict=True)]
    assert torch.equal(together, torch.stack(alone)) and len({v.item() for v in alone}) == 3
    assert (task.remaining(layouts, snapshots, x, q) > 0).all()
    slopes = [
        torch.autograd.grad(value, [x, q], allow_unused=True, materialize_grads=True)
        for value in (together.sum(), torch.stack(alone).sum())
    ]
    for ours, theirs in zip(*slopes, strict=True):
        assert torch.allclose(ours, theirs, rtol=1e-12, atol=1e-14)


def test_items_in_and_out_of_bags_mix_in_one_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    task = find_task("bag-items-2")
    layouts, snapshots, x, q = drawn(task, range(2))
    inside = {(id(snapshots[0]), 0): True, (id(snapshots[0]), 1): False}
    monkeypatch.setattr(task, "inside_bag", lambda s, body: inside.get((id(s), body), True))
    together = task.losses(layouts, snapshots, x, q)
    alone = [task.loss(*world) for world in zip(layouts, snapshots, x, q, strict=True)]
    assert torch.equal(together, torch.stack(alone))
    # the second world has both in the bag: what is left is their way to the zone
    away = np.linalg.norm(layouts[1].body_q[:, :2] - layouts[1].frame[:2], axis=1).mean()
    assert together[1].item() == pytest.approx(float(away), abs=1e-4)
    left = task.remaining(layouts, snapshots, x, q)
    inside[id(snapshots[0]), 1] = True
    # an item that gets into the bag is progress, though the loss alone may rise by it
    assert left[0] > task.remaining(layouts, snapshots, x, q)[0] >= 0


@pytest.mark.parametrize("name", TASKS)
def test_every_task_says_what_is_to_be_done(name: str) -> None:
    said = find_task(name).instruction
    assert said.endswith(".") and said[0].isupper() and len(said) > 8
    others = {find_task(other).instruction for other in TASKS if other != name}
    assert said not in others


def test_who_defines_one_of_the_two_losses_anew_means_both() -> None:
    class Twice(BlockNotarget):
        name: ClassVar[str] = "block-twice"

        def loss(self, layout, snapshot, particle_q, body_q):
            return 2 * BlockNotarget().loss(layout, snapshot, particle_q, body_q)

    class Thrice(Twice):
        def losses(self, layouts, snapshots, particle_q, body_q):
            return 3 * BlockNotarget().losses(layouts, snapshots, particle_q, body_q)

    layouts, snapshots, x, q = drawn(BlockNotarget(), range(1))
    once = BlockNotarget().losses(layouts, snapshots, x, q)
    for cls, factor in ((Twice, 2), (Thrice, 3)):
        task = cls()
        assert cls.has_loss()
        many = task.losses(layouts, snapshots, x, q)
        single = task.loss(layouts[0], snapshots[0], x[0], q[0])
        assert torch.equal(many, factor * once) and torch.equal(single, many[0])
    assert Twice.instruction == "Block twice."


def test_a_task_without_a_loss_says_so() -> None:
    task = find_task("cable-mask-goal")
    assert not task.has_loss()
    for call in (task.loss, task.losses):
        with pytest.raises(TypeError, match="no loss"):
            call([], [], torch.zeros(1, 2, 3), torch.zeros(1, 0, 7))
