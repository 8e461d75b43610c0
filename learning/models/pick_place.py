"""Pick and place heat maps of a Transporter whose networks are computed together (grouped.py).

What `Attention` and `Transport` say separately, from the same weights, to rounding, where the zeros
that crops need stand around features (`pad_features`): then all networks see the same pixels. When
acting, attention and query run once for a picture; key and goal, which see a mark at the pick, for
every pick that is weighed.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from .attention import Attention
from .crops import CropPixels, crop_pixels, crop_reach, crops_at, rotated_crops
from .grouped import Body, GroupedNetworks, Member, Window
from .images import normalise
from .transport import Transport, frame, pick_mark

__all__ = ["PickPlace"]


class PickPlace:
    """Heat maps of raw images (B, 4 k, H, W).

    Args:
        attention: where to pick
        transport: where to place; with `pad_features`, neither exact nor with the crop first
        bfloat16: see `GroupedNetworks`
    """

    def __init__(self, attention: Attention, transport: Transport, *, bfloat16: bool) -> None:
        self._transport = transport
        goal, pictures = transport.goal, transport.pictures
        seen = transport.key.pictures_channels
        current = (0, seen)
        members = {
            "attention": Member(attention.network, (0, attention.network.pictures_channels)),
            "key": Member(transport.key, current),
        }
        if goal is not None:
            members["goal"] = Member(goal, (seen, pictures * seen))
        members["query"] = Member(transport.query, current)
        self._placing = [name for name in members if name not in ("attention", "query")]
        self._networks = GroupedNetworks(members, alone="query", bfloat16=bfloat16)

    def both(self, image: Tensor, pick: Tensor, *, n_rotations: int) -> tuple[Tensor, Tensor]:
        """Pick logits (B, H, W), and place logits (B, R, H, W) for picks (B, 2) int64."""
        seen, pick = normalise(image), pick.cpu()
        body = self._networks.body(
            ["attention", *self._placing, "query"], seen, self._mark(seen, pick)
        )
        maps = self._networks.maps(body, ["attention", *self._placing])
        place = self._place(maps, body, pick, n_rotations)
        return maps["attention"][:, 0], place

    def both_at(self, image: Tensor, pick: Tensor, pixels: CropPixels) -> tuple[Tensor, Tensor]:
        """As `both`, given the `crop_pixels` of the picks, all on one device.

        The query is computed everywhere, not around the picks alone: no launch depends on where
        they are, so a CUDA graph can be replayed for others.
        """
        seen, transport = normalise(image), self._transport
        names = ["attention", *self._placing, "query"]
        maps = self._networks.maps(self._networks.body(names, seen, self._mark(seen, pick)), names)
        key, query = maps["key"], maps["query"]
        if "goal" in maps:
            factor = maps["goal"] + transport.goal_bias
            key, query = key * factor, query * factor
        kernels = crops_at(frame(query, transport.crop), pixels, size=transport.crop)
        place = transport.correlated(frame(key, transport.crop), kernels)
        return maps["attention"][:, 0], place

    def crop_pixels(self, pick: Tensor, shape: tuple[int, int], *, n_rotations: int) -> CropPixels:
        """What `both_at` cuts out of maps of a shape (H, W) for picks (B, 2) int64, on the CPU."""
        crop = self._transport.crop
        framed = shape[0] + crop, shape[1] + crop
        return crop_pixels(pick + crop // 2, size=crop, n_rotations=n_rotations, shape=framed)

    def each(self, image: Tensor, *, n_rotations: int) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
        """Pick logits (B, H, W), and what says place logits (B, R, H, W) for picks (B, 2) int64."""
        seen = normalise(image)
        body = self._networks.body(["attention", "query"], seen)

        def place(pick: Tensor) -> Tensor:
            marked = self._networks.body(self._placing, seen, self._mark(seen, pick))
            maps = self._networks.maps(marked, self._placing)
            return self._place(maps, body, pick.cpu(), n_rotations)

        return self._networks.maps(body, ["attention"])["attention"][:, 0], place

    def _mark(self, seen: Tensor, pick: Tensor) -> Tensor | None:
        return pick_mark(seen, pick) if self._transport.mark_pick else None

    def _place(self, maps: dict[str, Tensor], body: Body, pick: Tensor, n_rotations: int) -> Tensor:
        """Place logits of features, the query's around the picks alone."""
        transport, key = self._transport, maps["key"]
        crop, shape = transport.crop, key.shape[-2:]
        window = Window.around(pick, reach=crop_reach(crop, n_rotations), shape=tuple(shape))
        query = self._networks.maps(body, ["query"], window)["query"]
        if "goal" in maps:
            factor = maps["goal"] + transport.goal_bias
            key, query = key * factor, query * window.of(factor)
        framed, half = frame(query, crop), crop // 2
        # Coordinates are those of the framed picture: rounding decides what a turned crop samples.
        kernels = [
            rotated_crops(
                framed[k : k + 1],
                pick[k : k + 1] + half,
                size=crop,
                n_rotations=n_rotations,
                origin=start,
                shape=tuple(side + crop for side in shape),
            )
            for k, start in enumerate(window.starts)
        ]
        return transport.correlated(frame(key, crop), torch.cat(kernels))
