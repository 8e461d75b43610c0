"""A step's losses and gradients as one CUDA graph.

A step is some thousand small kernels. One by one, a GPU waits for the processor that launches them;
as a graph, they are launched at once. To make a batch then takes longer than to learn from it, so
threads make batches ahead. Losses and gradients are those of `Transporter.forward`, to rounding.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, NamedTuple, TypeVar

import torch
from torch import Tensor, nn

from ..models.batch import Batch, Labels, Losses, labels_of, losses_of
from ..models.crops import CropPixels
from ..models.transporter import Transporter

__all__ = [
    "GraphedLosses",
    "MadeAhead",
    "StepInputs",
    "can_be_graphed",
    "inputs_of",
    "losses_of_inputs",
]

_AHEAD, _THREADS = 8, 2
"""Batches that are made ahead, and threads that make them."""
_WARM_UP = 3
"""Steps before the graph is recorded, in which libraries choose their kernels and take memory."""

T = TypeVar("T")


class StepInputs(NamedTuple):
    """All that a step reads: tensors whose shapes never change, so that a graph can be replayed.

    Attributes:
        image: (B, 4 k, H, W) float32, as of `Batch`
        pick: (B, 2) int64
        crops: pixels of the query's crops
        around: pixels of the lift head's crops; empty without one
        labels: what is to be said
    """

    image: Tensor
    pick: Tensor
    crops: CropPixels
    around: CropPixels
    labels: Labels

    def tensors(self) -> tuple[Tensor, ...]:
        """All of them in a row."""
        return (self.image, self.pick, *self.crops, *self.around, *self.labels)

    def mapped(self, change: Callable[[Tensor], Tensor]) -> StepInputs:
        """Each of them changed."""
        return StepInputs(
            change(self.image),
            change(self.pick),
            CropPixels(*map(change, self.crops)),
            CropPixels(*map(change, self.around)),
            Labels(*map(change, self.labels)),
        )


def can_be_graphed(agent: nn.Module) -> bool:
    """Whether an agent sees pictures by networks that are computed together."""
    return isinstance(agent, Transporter) and agent.pick_place is not None


def inputs_of(agent: Transporter, batch: Batch) -> StepInputs:
    """What a step reads of a batch, on the CPU.

    Raises:
        InputError: a labelled pixel outside of the image.
    """
    config, shape = agent.config, agent.config.shape
    n, pick = config.n_rotations_train, batch.pick
    labels = labels_of(batch, shape, n_rotations=n)
    assert agent.pick_place is not None, "only networks that are computed together"
    crops = agent.pick_place.crop_pixels(pick, shape, n_rotations=n)
    around = CropPixels(pick[:, :0], pick[:, :0])
    if agent.lift is not None:
        around = agent.lift.crop_pixels(pick, shape)
    return StepInputs(batch.image, pick, crops, around, labels)


def losses_of_inputs(agent: Transporter, inputs: StepInputs) -> Losses:
    """Losses, as `Transporter.forward` says them, by nothing but tensors on one device."""
    assert agent.pick_place is not None, "only networks that are computed together"
    heat, logits = agent.pick_place.both_at(inputs.image, inputs.pick, inputs.crops)
    lifts = None
    if agent.lift is not None:
        lifts = agent.lift.at(inputs.image, inputs.around)
    return losses_of(heat, logits, lifts, inputs.labels)


class MadeAhead(Generic[T]):
    """What belongs to each step, made by threads some steps before it is taken.

    As a context manager it ends its threads.

    Args:
        make: of a step; several threads call it
        last: number of the last step
    """

    def __init__(self, make: Callable[[int], T], *, last: int) -> None:
        self._make, self._last = make, last
        self._threads = ThreadPoolExecutor(_THREADS)
        self._made: dict[int, Future[T]] = {}

    def __enter__(self) -> MadeAhead[T]:
        return self

    def __exit__(self, *_: object) -> None:
        self._threads.shutdown(cancel_futures=True)

    def take(self, step: int) -> T:
        """That of a step; each is taken once, in their order. Raises what `make` raised for it."""
        for ahead in range(step, min(step + _AHEAD, self._last) + 1):
            if ahead not in self._made:
                self._made[ahead] = self._threads.submit(self._make, ahead)
        return self._made.pop(step).result()


class GraphedLosses:
    """Losses of a step and their gradient, by a graph that is recorded when it is first asked for.

    As a context manager it ends its threads.

    Args:
        agent: on a GPU, its networks computed together (`pick_place`)
        batch: makes the batch of a step on the CPU; threads call it
        last: number of the last step
    """

    def __init__(self, agent: Transporter, batch: Callable[[int], Batch], *, last: int) -> None:
        def make(step: int) -> StepInputs:
            return inputs_of(agent, batch(step)).mapped(Tensor.pin_memory)

        self._agent, self._parameters = agent, list(agent.parameters())
        self._ahead = MadeAhead(make, last=last)
        self._inputs: StepInputs | None = None
        self._graph, self._copied = torch.cuda.CUDAGraph(), torch.cuda.Event()

    def __enter__(self) -> GraphedLosses:
        return self

    def __exit__(self, *_: object) -> None:
        self._ahead.__exit__()

    def __call__(self, step: int) -> tuple[Losses, Tensor]:
        """Losses of a step, and the gradient of their sum by all parameters, one after another.

        The next call overwrites the gradient.
        """
        inputs = self._ahead.take(step)
        if self._inputs is None:
            self._record(inputs)
        else:
            self._copied.synchronize()  # the GPU may lag by a step, not by the memory of many
            for kept, new in zip(self._inputs.tensors(), inputs.tensors(), strict=True):
                kept.copy_(new, non_blocking=True)
        self._copied.record()
        self._graph.replay()
        return Losses(*(each.clone() for each in self._losses)), self._gradient

    def _record(self, inputs: StepInputs) -> None:
        device = self._parameters[0].device
        self._inputs = inputs.mapped(lambda each: each.to(device))
        stream = torch.cuda.Stream(device)
        stream.wait_stream(torch.cuda.current_stream(device))
        with torch.cuda.stream(stream):
            for _ in range(_WARM_UP):
                self._once(self._inputs)
        torch.cuda.current_stream(device).wait_stream(stream)
        # other threads pin memory meanwhile, which is no part of the graph
        with torch.cuda.graph(self._graph, capture_error_mode="thread_local"):
            self._losses, self._gradient = self._once(self._inputs)

    def _once(self, inputs: StepInputs) -> tuple[Losses, Tensor]:
        losses = losses_of_inputs(self._agent, inputs)
        parts = torch.autograd.grad(losses.total(), self._parameters, allow_unused=True)
        filled = (
            torch.zeros_like(parameter) if part is None else part
            for parameter, part in zip(self._parameters, parts, strict=True)
        )
        flat = torch.cat([each.flatten() for each in filled])
        return Losses(*(each.detach() for each in losses)), flat
