"""A step as a CUDA graph has it: the agent's losses and gradients, and nothing asked of data."""

from __future__ import annotations

import threading
from dataclasses import replace

import pytest
import torch
from fixtures.labelled_images import labelled_images
from torch._subclasses.fake_tensor import DataDependentOutputException, FakeTensorMode

from learning.models.batch import Batch
from learning.models.transporter import PRESETS, GoalSplit, GoalStack, Transporter
from learning.training.graphed import (
    GraphedLosses,
    MadeAhead,
    can_be_graphed,
    inputs_of,
    losses_of_inputs,
)
from warp_deform.errors import InputError

SMALL = replace(PRESETS["fast"], scale=4, width=0.125, crop=16, lifts=(0.05, 0.3))
KINDS = (
    (Transporter, SMALL),
    (Transporter, replace(SMALL, n_rotations_train=24)),
    (GoalSplit, replace(SMALL, n_rotations_train=6, lifts=(0.05,))),
    (GoalStack, replace(SMALL, equivariant=False, mark_pick=False)),
)


@pytest.mark.parametrize(("kind", "config"), KINDS)
def test_losses_and_gradients_are_the_agent_s(kind, config) -> None:
    """Picks in corners too, where crops reach beyond the picture."""
    agent = kind(config, seed=0)
    labelled = labelled_images(agent, torch.tensor([[0, 39], [41, 18], [79, 2]]))
    wanted = agent(labelled)
    got = losses_of_inputs(agent, inputs_of(agent, labelled))
    assert wanted.transport.item() > 0.1
    for name, value in got._asdict().items():
        assert value.item() == pytest.approx(getattr(wanted, name).item(), rel=1e-5), name
    parameters = list(agent.parameters())
    flat = [
        torch.cat([each.flatten() for each in torch.autograd.grad(losses.total(), parameters)])
        for losses in (wanted, got)
    ]
    assert float((flat[1] - flat[0]).norm()) < 1e-5 * float(flat[0].norm())


@pytest.mark.parametrize(("kind", "config"), KINDS[1:3])
def test_nothing_that_is_done_depends_on_a_number(kind, config) -> None:
    """A tensor without numbers refuses to be asked for one, as the recording of a graph does."""
    agent = kind(config, seed=0)
    inputs = inputs_of(agent, labelled_images(agent, torch.tensor([[30, 20]])))
    losses_of_inputs(agent, inputs)  # what is only done once, as before the recording
    with FakeTensorMode(allow_non_fake_inputs=True) as mode:
        fake = inputs.mapped(mode.from_tensor)
        losses = losses_of_inputs(agent, fake)
        gradients = torch.autograd.grad(losses.total(), list(agent.parameters()))
        shapes = [each.shape for each in agent.parameters()]
        assert [each.shape for each in gradients] == shapes
        with pytest.raises(DataDependentOutputException):
            agent(Batch(fake.image, fake.pick, fake.pick, fake.image[:, 0, 0, 0], fake.labels.lift))


def test_what_is_graphed_and_what_is_refused() -> None:
    agent = Transporter(SMALL, seed=0)
    assert can_be_graphed(agent) and not can_be_graphed(torch.nn.Linear(2, 2))
    assert not can_be_graphed(Transporter(replace(SMALL, pad_features=False), seed=0))
    outside = labelled_images(agent, torch.tensor([[80, 3]]))
    with pytest.raises(InputError, match=r"pick: pixel \[80, 3\] lies outside of 80 x 40"):
        inputs_of(agent, outside)
    inputs = inputs_of(agent, labelled_images(agent, torch.tensor([[5, 3]])))
    assert len(inputs.tensors()) == 9 and inputs.mapped(torch.clone).tensors()[1].equal(inputs.pick)


def test_batches_are_made_ahead_once_each_and_what_goes_wrong_is_told_at_its_step() -> None:
    made = []

    def make(step: int) -> int:
        made.append(step)
        if step == 7:
            raise InputError("no batch 7")
        return 10 * step

    with MadeAhead(make, last=9) as ahead:
        assert [ahead.take(step) for step in range(3, 7)] == [30, 40, 50, 60]
        with pytest.raises(InputError, match="no batch 7"):
            ahead.take(7)
        assert [ahead.take(step) for step in (8, 9)] == [80, 90]
    assert sorted(made) == list(range(3, 10)), "each once, and none beyond the last"


def test_who_stops_early_waits_for_nothing_more() -> None:
    begun, go_on = [], threading.Event()

    def make(step: int) -> int:
        begun.append(step)
        assert step == 1 or go_on.wait(60)
        return step

    with MadeAhead(make, last=1000) as ahead:
        assert ahead.take(1) == 1
        go_on.set()
    assert len(begun) < 12


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")
def test_a_graph_is_replayed_with_new_weights_and_batches() -> None:
    """On a GPU: steps by the graph, and by the agent alone, in turns with a change of weights."""
    agent = Transporter(SMALL, seed=0).cuda()
    batches = [labelled_images(agent, torch.tensor([[7 * k, 3 * k]])) for k in range(1, 5)]
    with GraphedLosses(agent, lambda step: batches[step - 1], last=4) as graphed:
        for step, labelled in enumerate(batches, 1):
            losses, gradient = graphed(step)
            wanted = agent(labelled._replace(image=labelled.image.cuda()))
            parts = torch.autograd.grad(wanted.total(), list(agent.parameters()))
            expected = torch.cat([part.flatten() for part in parts])
            assert losses.total().item() == pytest.approx(wanted.total().item(), rel=1e-2)
            assert (gradient - expected).norm() < 0.02 * expected.norm()
            with torch.no_grad():
                for each in agent.parameters():
                    each.add_(torch.randn_like(each), alpha=1e-3)
