"""The networks of an agent computed together: one gather of their kernels, blocks by hand.

`resnet.ResNet43` is the plain form and holds the weights. This one computes the same maps from the
same weights, to rounding, and costs less: whole kernels are one gather (gather.py), a block is one
node of autograd's graph (bottleneck.py), and the last stage, at the finest resolution, runs on a
window where no more of a map is needed.

In float32 the networks follow one another: convolutions in groups are slower there. In bfloat16
they are one network, whose channels stand side by side and whose convolutions have groups: small
ones alone would not keep the processor's matrix units busy. 1x1 convolutions of few channels are
dense there, and zero off the diagonal. Correlations, losses and sums of gradients stay float32.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from .bottleneck import bottleneck, pointwise
from .gather import KernelGather
from .resnet import GROWING, ResNet43, shrunk

__all__ = ["Body", "GroupedNetworks", "Member", "Window"]

_DENSE = 16
"""1x1 convolutions of up to so many channels are dense where networks stand side by side."""
_ALIGNED = 16
"""Channels that the stem of several networks reads are filled up to a multiple of this."""
_HALO = 3
"""Pixels from a window's border in which the last stage may differ: two 3x3 convolutions and an
interpolation."""

Bundle = tuple[str, ...]
"""Names of networks that are computed as one."""


@dataclass(frozen=True)
class Member:
    """A network, and the channels of what all see that it sees: the first, and past the last."""

    network: ResNet43
    channels: tuple[int, int]


@dataclass(frozen=True)
class Window:
    """A part of maps, equally large for every picture of a batch.

    Attributes:
        starts: first row and column of every picture's, even
        size: height and width, even
    """

    starts: tuple[tuple[int, int], ...]
    size: tuple[int, int]

    @classmethod
    def around(cls, points: Tensor, *, reach: int, shape: tuple[int, int]) -> Window:
        """Windows of maps (H, W) in which the last stage is right `reach` pixels around points.

        Args:
            points: (B, 2) int64 on the CPU, row and column
        """
        size = tuple(min(side, 2 * (reach + _HALO) + 2) for side in shape)
        starts = []
        for point in points.tolist():
            first = (
                max(0, min((at - reach - _HALO) // 2 * 2, side - extent))
                for at, side, extent in zip(point, shape, size, strict=True)
            )
            starts.append(tuple(first))
        return cls(tuple(starts), size)  # type: ignore[arg-type]

    def of(self, x: Tensor, *, times: int = 1) -> Tensor:
        """The window of maps (B, C, H, W), or of maps so many `times` smaller."""
        height, width = (side // times for side in self.size)
        parts = []
        for k, start in enumerate(self.starts):
            row, column = (each // times for each in start)
            parts.append(x[k : k + 1, :, row : row + height, column : column + width])
        return parts[0] if len(parts) == 1 else torch.cat(parts)


@dataclass(frozen=True)
class Body:
    """What networks compute before their last stage, and its kernels, by bundles.

    Attributes:
        coarse: maps of half the height and width
        fine: first features, which join the last stage of networks with skip connections
        last: kernels of the last stages
    """

    coarse: Mapping[Bundle, Tensor]
    fine: Mapping[Bundle, Tensor]
    last: Mapping[Bundle, tuple[Tensor, ...]]


class GroupedNetworks:
    """Networks of one configuration, computed together.

    Args:
        members: by name, in the order in which they stand side by side
        alone: name of the one whose last stage runs apart from the others', on a window perhaps;
            the last of them
        bfloat16: compute as one network in bfloat16, in place of one by one in float32
    """

    def __init__(self, members: Mapping[str, Member], *, alone: str, bfloat16: bool) -> None:
        self._members, self._alone, self._bfloat16 = dict(members), alone, bfloat16
        self._plans: dict[Bundle, _Plan] = {}

    def body(self, names: Sequence[str], seen: Tensor, mark: Tensor | None = None) -> Body:
        """All but the last stage of some networks.

        Args:
            seen: what all see (B, C, H, W)
            mark: what those with marks see besides (B, marks, H, W)
        """
        chosen = tuple(name for name in self._members if name in names)
        if chosen not in self._plans:
            self._plans[chosen] = _Plan(
                {name: self._members[name] for name in chosen},
                marks=0 if mark is None else mark.shape[1],
                alone=self._alone,
                side_by_side=self._bfloat16,
            )
        plan = self._plans[chosen]
        dtype = torch.bfloat16 if self._bfloat16 else seen.dtype
        kernels = iter(plan.gather(dtype))
        coarse, fine = {}, {}
        for bundle in plan.bodies:
            shown = self._shown(bundle, seen, mark).to(dtype)
            shown = shown.contiguous(memory_format=torch.channels_last)
            coarse[bundle], fine[bundle] = self._run_body(bundle, shown, kernels)
        last = {
            bundle: tuple(next(kernels) for _ in range(count))
            for bundle, count in plan.tails.items()
        }
        return Body(coarse, fine, last)

    def maps(
        self, body: Body, names: Sequence[str], window: Window | None = None
    ) -> dict[str, Tensor]:
        """Maps (B, out, H, W) float32 of networks by name, or windows of them.

        Of the networks of a bundle all are asked for, or none.
        """
        found = {}
        for bundle, kernels in body.last.items():
            if bundle[0] not in names:
                continue
            whole = next(each for each in body.coarse if set(bundle) <= set(each))
            first, end = whole.index(bundle[0]), whole.index(bundle[-1]) + 1
            sources = []
            for maps, times in ((body.coarse[whole], 2), (body.fine[whole], 1)):
                own = maps.shape[1] // len(whole)
                part = maps[:, first * own : end * own]
                sources.append(part if window is None else window.of(part, times=times))
            x, fine = (each.contiguous(memory_format=torch.channels_last) for each in sources)
            last = len(self._members[bundle[0]].network.stages) - 1
            y = self._run_stage(bundle, last, x, fine, iter(kernels))
            own = y.shape[1] // len(bundle)
            for k, name in enumerate(bundle):
                out = self._members[name].network.out_channels
                found[name] = y[:, k * own : k * own + out].float()
        return {name: found[name] for name in names}

    def _shown(self, bundle: Bundle, seen: Tensor, mark: Tensor | None) -> Tensor:
        """What the networks of a bundle see, in the order of their stem's kernel."""
        if len(bundle) == 1:
            (member,) = (self._members[name] for name in bundle)
            first, end = member.channels
            own = seen[:, first:end]
            if member.network.mark is None or mark is None:
                return own
            return torch.cat([own, mark], dim=1)
        parts = [seen] if mark is None else [seen, mark]
        count = sum(part.shape[1] for part in parts)
        parts.append(seen.new_zeros(len(seen), _filled(count) - count, *seen.shape[2:]))
        return torch.cat(parts, dim=1)

    def _run_body(
        self, bundle: Bundle, x: Tensor, kernels: Iterator[Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Maps before the last stage, and the features of the first one."""
        members = [self._members[name] for name in bundle]
        kernel, bias = next(kernels), next(kernels)
        if any(member.network.mark is not None for member in members):
            bias = bias + next(kernels)
        x = functional.relu(functional.conv2d(x, kernel, bias, padding=1), inplace=True)
        stages = members[0].network.stages
        finer: list[Tensor] = []
        for number in range(len(stages) - 1):
            k = number - (len(stages) - GROWING)
            source = finer[GROWING - 1 - k] if k >= 0 else None
            x = self._run_stage(bundle, number, x, source, kernels)
            finer.append(x)
        return x, finer[0]

    def _run_stage(
        self,
        bundle: Bundle,
        number: int,
        x: Tensor,
        finer: Tensor | None,
        kernels: Iterator[Tensor],
    ) -> Tensor:
        """A stage of the networks of a bundle, and the features that join it."""
        network, groups = self._members[bundle[0]].network, len(bundle)
        stage, lateral = network.stages[number], None
        if finer is not None and network.laterals:
            lateral = pointwise(finer, next(kernels), next(kernels), groups=groups)
        x = shrunk(x, stage.project.stride, turns=stage.project.turns)
        for block in (stage.project, stage.identity):
            pairs = [
                (next(kernels), next(kernels)) for _ in range(3 + (block.shortcut is not None))
            ]
            x = bottleneck(
                x,
                lateral if block is stage.project else None,
                pairs,
                groups=groups,
                upsample=block.upsample,
                activate=block.activate,
            )
        return x


class _Plan:
    """Which networks are computed as one, and where their kernels come from.

    Attributes:
        bodies: bundles before the last stage
        tails: bundles of the last stage, and how many kernels and biases it has
        gather: of all kernels, in the order in which they are taken
    """

    def __init__(
        self, members: Mapping[str, Member], *, marks: int, alone: str, side_by_side: bool
    ) -> None:
        names = tuple(members)
        self.bodies = [names] if side_by_side else [(name,) for name in names]
        together = tuple(name for name in names if name != alone)
        tails = [together, (alone,) if alone in names else ()] if side_by_side else self.bodies
        networks = [member.network for member in members.values()]
        learnt = [each for network in networks for each in network.convolutions()]
        self.gather = KernelGather(learnt)
        last = len(networks[0].stages) - 1
        for bundle in self.bodies:
            self._add_stem([members[name] for name in bundle], marks)
            for number in range(last):
                self._add_stage([members[name].network for name in bundle], number)
        self.tails: dict[Bundle, int] = {}
        for bundle in filter(None, tails):
            before = len(self.gather)
            self._add_stage([members[name].network for name in bundle], last)
            self.tails[bundle] = len(self.gather) - before

    def _add_stem(self, members: Sequence[Member], marks: int) -> None:
        """The first convolutions, and those of marks: one, which reads what `_shown` says."""
        if len(members) == 1:
            ((start, width),) = (member.channels for member in members)
            width, marks = width - start, marks if members[0].network.mark is not None else 0
            read = width + marks
        else:
            start, width = 0, max(member.channels[1] for member in members)
            read = _filled(width + marks)
        kernels, biases, of_marks = [], [], []
        for member in members:
            first, end = (channel - start for channel in member.channels)
            weight, bias = self.gather.numbers(member.network.stem)
            kernel = weight.new_zeros(len(weight), read, *weight.shape[2:])
            kernel[:, first:end], beside = weight, torch.zeros_like(bias)
            if member.network.mark is not None:
                weight, beside = self.gather.numbers(member.network.mark)
                kernel[:, width : width + marks] = weight
            kernels.append(kernel)
            biases.append(bias)
            of_marks.append(beside)
        self.gather.add(torch.cat(kernels))
        self.gather.add(torch.cat(biases))
        if any(member.network.mark is not None for member in members):
            self.gather.add(torch.cat(of_marks))

    def _add_stage(self, networks: Sequence[ResNet43], number: int) -> None:
        """A stage's convolutions, each of all networks, in the order in which they run."""
        k = number - (len(networks[0].stages) - GROWING)
        each = [[*network.stages[number].convolutions()] for network in networks]
        if k >= 0 and networks[0].laterals:
            laterals = [network.laterals[k] for network in networks]
            each = [[lateral, *own] for lateral, own in zip(laterals, each, strict=True)]
        for convolutions in zip(*each, strict=True):
            weights, biases = zip(*map(self.gather.numbers, convolutions), strict=True)
            self.gather.add(_side_by_side(weights))
            self.gather.add(torch.cat([_wider(bias, (_widest(biases, 0),)) for bias in biases]))


def _side_by_side(kernels: Sequence[Tensor]) -> Tensor:
    """Kernels (out, C, size, size) of networks as one, in groups or dense; see the module."""
    out, into = (_widest(kernels, axis) for axis in range(2))
    size = kernels[0].shape[2:]
    if len(kernels) == 1 or size != (1, 1) or max(out, into) > _DENSE:
        return torch.cat([_wider(kernel, (out, into, *size)) for kernel in kernels])
    dense = kernels[0].new_zeros(len(kernels) * out, len(kernels) * into, *size)
    for k, kernel in enumerate(kernels):
        rows, columns = kernel.shape[:2]
        dense[k * out : k * out + rows, k * into : k * into + columns] = kernel
    return dense


def _wider(x: Tensor, shape: tuple[int, ...]) -> Tensor:
    """A tensor with zeros behind, up to a shape."""
    y = x.new_zeros(shape)
    y[tuple(slice(side) for side in x.shape)] = x
    return y


def _widest(tensors: Sequence[Tensor], axis: int) -> int:
    return max(tensor.shape[axis] for tensor in tensors)


def _filled(channels: int) -> int:
    return -(-channels // _ALIGNED) * _ALIGNED
