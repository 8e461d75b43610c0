"""Where to pick: a heat map over the image.

Source: Zeng et al., CoRL 2020; Seita et al., ICRA 2021. Of the original's attention module,
`exact=True` reproduces the padding of the image to a square, which doubles its cost and changes
what the network sees beyond the long sides; otherwise the image goes in as it is. Left out: the
machinery for several pick rotations, unused in every task; and the switch named softmax, which
reshapes without a softmax: `forward` returns logits and says so. Goal-conditioned agents stack the
goal's image below the current one; features are not multiplied here in any variant.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from .images import normalise
from .resnet import NetworkConfig, ResNet43

__all__ = ["Attention"]


class Attention(nn.Module):
    """Raw images (B, 4 k, H, W) -> pick logits (B, H, W), before any softmax.

    9,833,203 parameters for one picture at width 1.

    Args:
        pictures: 1, or 2 where the goal is stacked below the current one
        config: the network
        exact: pad to a square, as the original does
        generator: draws the initial weights
    """

    def __init__(
        self,
        *,
        pictures: int = 1,
        config: NetworkConfig = NetworkConfig(),  # noqa: B008 (frozen)
        exact: bool = False,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self.exact = exact
        self.network = ResNet43(1, pictures=pictures, config=config, generator=generator)

    def forward(self, image: Tensor) -> Tensor:
        """Pick logits (B, H, W) of raw images (B, 4 k, H, W)."""
        rows, columns = image.shape[-2:]
        side = max(rows, columns) if self.exact else 0
        above, left = max(0, side - rows) // 2, max(0, side - columns) // 2
        x = normalise(functional.pad(image, (left, left, above, above)))
        logits: Tensor = self.network(x)[:, 0, above : above + rows, left : left + columns]
        return logits
