"""Transporter, Transporter-Goal-Split and Transporter-Goal-Stack: where to pick, place and lift.

Source: Zeng et al., CoRL 2020; Seita et al., ICRA 2021, sections on Transporters and their
goal-conditioned variants, appendix on training; and what their code does, which the modules beside
this one take up point by point.

`exact=True` computes what the original computes, by the same operations. Without it, the preset
`paper` differs by a pick network that sees the image unpadded (attention.py), and by rounding.
Kept in both: the crop comes after the query for Transporter and Goal-Split, before it for
Goal-Stack (the original's default, which only the plain Transporter's configuration overrides);
rotations are counted separately for training (24) and evaluation (1 in most of the original's
results). The lift is ours: the original reads the height of the motion from the simulator.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from warp_deform.errors import InputError
from warp_deform.rendering.pixels import SHAPE

from .attention import Attention
from .batch import Batch, Labels, Losses, labels_of, losses_of
from .choice import choose
from .images import CHANNELS, image_tensor
from .lift import LiftHead
from .pick_place import PickPlace
from .resnet import STRIDE, NetworkConfig
from .transport import Transport

__all__ = [
    "PRESETS",
    "GoalSplit",
    "GoalStack",
    "Picture",
    "PixelActions",
    "Transporter",
    "TransporterConfig",
]

Picture = tuple[np.ndarray, np.ndarray]
"""Colour (320, 160, 3) uint8 and height (320, 160) float32 [m], as in an observation."""

_MOST_CHOICES, _MOST_LIFT = 360, 1.0  # far beyond what is sensible: a file may say anything


@dataclass(frozen=True, kw_only=True)
class TransporterConfig:
    """Sizes and choices of a Transporter; the defaults are the paper's."""

    scale: int = 1
    """Camera pixels along the side of a network pixel: 1 for 320 x 160, 2 for 160 x 80."""
    width: float = 1.0
    """Channels relative to the original's."""
    skips: bool = False
    """Finer features join the coarse ones that grow, as in U-Nets: picks become sharp."""
    equivariant: bool = False
    """What networks say turns with the picture by quarter turns (quarter_turns.py)."""
    fine: bool = False
    """Show networks every camera pixel: those that a network pixel covers are channels of their
    own, in place of their mean."""
    crop: int = 64
    """Side of the crop around the pick [network pixels]; 64 are 0.2 m at scale 1."""
    crop_before_query: bool | None = None
    """Run the query on crops of the image; None: as the original does for the agent."""
    gain: float = 1.0
    """What place logits are multiplied by. The original's, means over a crop of products of small
    features, start within 0.001 of each other, and learning where to place begins late."""
    focus: float = 0.0
    """Weight of the mean close to the pick, where that over the whole crop weighs 1. There the
    picked thing is a few pixels of a thousand; with 0.1, where it belongs is learnt in far fewer
    steps."""
    mark_pick: bool = False
    """Show the networks that say where to place how far every pixel is from the pick."""
    pad_features: bool = False
    """Put the zeros that crops need beyond the picture around features, not around the picture:
    networks see 1.7 times fewer pixels at 160 x 80 with crops of 32."""
    goal_bias: float = 0.0
    """Added to the goal's features in Goal-Split: with 1 they multiply by about 1 at first."""
    n_rotations_train: int = 24
    """Place rotations told apart in training; 24 are steps of 15 degrees."""
    n_rotations_eval: int = 1
    """Place rotations considered when acting; with 1 the place yaw is always 0."""
    picks: int = 1
    """So many of the most probable picks are weighed by how sure their places are (choice.py)."""
    lifts: tuple[float, ...] = (0.04,)
    """Lifts of the task's stages [m]; with one there is nothing to predict and no lift head."""
    bfloat16: bool = False
    """Convolve in bfloat16: `paper` is 3 times faster where processors multiply it natively."""
    exact: bool = False
    """Compute by the original's operations, several times slower: for parity."""

    def __post_init__(self) -> None:
        sides = [side / self.scale if self.scale >= 1 else math.nan for side in SHAPE]
        if any(side % STRIDE != 0 for side in sides):
            raise InputError(f"scale: must divide the picture into eights, got {self.scale}")
        if self.crop < STRIDE or self.crop % STRIDE:
            raise InputError(f"crop: a multiple of {STRIDE} pixels is needed, got {self.crop}")
        for name in ("n_rotations_train", "n_rotations_eval", "picks"):
            if not 1 <= getattr(self, name) <= _MOST_CHOICES:
                raise InputError(
                    f"{name}: 1 to {_MOST_CHOICES} are possible, got {getattr(self, name)}"
                )
        if not (0 < self.gain < math.inf and 0 <= self.focus < math.inf):
            raise InputError(f"gain {self.gain} and focus {self.focus}: above 0, and 0 or more")
        if not math.isfinite(self.goal_bias):
            raise InputError(f"goal_bias: must be finite, got {self.goal_bias}")
        if not self.lifts or not all(0 < lift <= _MOST_LIFT for lift in self.lifts):
            raise InputError(
                f"lifts: one or more, up to {_MOST_LIFT} m, are needed, got {list(self.lifts)}"
            )
        _ = self.network  # refuses what it cannot be built from

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of the network's image [pixels]."""
        return SHAPE[0] // self.scale, SHAPE[1] // self.scale

    @property
    def images(self) -> int:
        """How many images a picture becomes, see `images.image_tensor`."""
        return self.scale**2 if self.fine else 1

    @property
    def network(self) -> NetworkConfig:
        """What the agent's networks have in common."""
        return NetworkConfig(
            width=self.width,
            skips=self.skips,
            equivariant=self.equivariant,
            subpixels=self.scale if self.fine else 1,
            bfloat16=self.bfloat16,
        )

    def to_network(self, pixel: np.ndarray) -> np.ndarray:
        """Network pixels (..., 2) int64 that hold camera pixels (..., 2) int."""
        return np.asarray(pixel, dtype=np.int64) // self.scale

    def to_camera(self, pixel: np.ndarray) -> np.ndarray:
        """Centres (..., 2) float64 of network pixels (..., 2), in camera pixels."""
        return (np.asarray(pixel, dtype=float) + 0.5) * self.scale - 0.5


PRESETS = {
    "paper": TransporterConfig(),
    # benchmarks/models.py measures what a step costs, ablation.py what each part brings.
    "fast": TransporterConfig(
        scale=2,
        fine=True,
        width=0.25,
        skips=True,
        equivariant=True,
        crop=32,
        crop_before_query=False,
        gain=100.0,
        focus=0.1,
        mark_pick=True,
        pad_features=True,
        goal_bias=1.0,
        n_rotations_train=1,
        picks=5,
    ),
}


class PixelActions(NamedTuple):
    """What to do in each of B pictures.

    Attributes:
        pick: (B, 2) float64 row and column [camera pixels]
        place: as `pick`
        place_yaw: (B,) float64 [rad], within -pi to pi; the pick yaw is 0
        lift: (B,) float64 [m]
    """

    pick: np.ndarray
    place: np.ndarray
    place_yaw: np.ndarray
    lift: np.ndarray


class Transporter(nn.Module):
    """Pick by attention, place by transport, lift by a head on the pick's crop.

    Examples:
        >>> agent = Transporter(PRESETS["fast"], seed=0)
        >>> color, height = np.zeros((320, 160, 3), np.uint8), np.zeros((320, 160), np.float32)
        >>> agent.act(agent.image((color, height))[None]).place.shape
        (1, 2)

    Args:
        config: sizes and choices
        seed: of the initial weights
    """

    name: ClassVar[str] = "transporter"
    sees: ClassVar[Literal["pictures", "traces", "state"]] = "pictures"
    pictures: ClassVar[int] = 1
    """1, or 2 where the goal is seen too."""
    goal_split: ClassVar[bool] = False
    """The goal's picture has a network of its own."""
    crop_before_query: ClassVar[bool] = False

    def __init__(self, config: TransporterConfig, *, seed: int) -> None:
        super().__init__()
        self.config = config
        generator = torch.Generator().manual_seed(seed)
        self.attention = Attention(
            pictures=self.pictures,
            config=config.network,
            exact=config.exact,
            generator=generator,
        )
        before = config.crop_before_query
        self.transport = Transport(
            pictures=self.pictures,
            goal_split=self.goal_split,
            config=config.network,
            crop=config.crop,
            crop_before_query=self.crop_before_query if before is None else before,
            gain=config.gain,
            focus=config.focus,
            goal_bias=config.goal_bias,
            mark_pick=config.mark_pick,
            pad_features=config.pad_features,
            exact=config.exact,
            generator=generator,
        )
        self.pick_place: PickPlace | None = None
        """What computes attention and transport together, where it can."""
        if config.pad_features and not (config.exact or self.transport.crop_before_query):
            self.pick_place = PickPlace(self.attention, self.transport, bfloat16=config.bfloat16)
        n_lifts = len(config.lifts)
        self.lift = (
            LiftHead(n_lifts, images=config.images, crop=config.crop, generator=generator)
            if n_lifts > 1
            else None
        )

    def image(self, current: Picture, goal: Picture | None = None) -> Tensor:
        """The network's image (4 k, H, W) of a picture, and of the goal's if the agent has one.

        Raises:
            InputError: a goal is missing, or given to an agent that has none.
        """
        if (goal is not None) != (self.pictures == 2):
            raise InputError(f"{self.name}: {self.pictures - 1} goal pictures are needed")
        pictures = [current] if goal is None else [current, goal]
        scale, fine = self.config.scale, self.config.fine
        return torch.cat([image_tensor(*each, scale=scale, fine=fine) for each in pictures])

    def forward(self, batch: Batch) -> Losses:
        """Losses of a batch.

        Raises:
            InputError: an image of another shape, or a labelled pixel outside of it.
        """
        image, n = batch.image, self.config.n_rotations_train
        self._check(image)
        labels = labels_of(batch, self.config.shape, n_rotations=n)
        if self.pick_place is not None:
            heat, logits = self.pick_place.both(image, batch.pick, n_rotations=n)
        else:
            heat = self.attention(image)
            logits = self.transport(image, batch.pick, n_rotations=n)
        lifts = None if self.lift is None else self.lift(image, batch.pick)
        there = Labels(*(each.to(image.device) for each in labels))
        return losses_of(heat, logits, lifts, there)

    @torch.no_grad()
    def act(self, image: Tensor, *, avoid: Tensor | None = None) -> PixelActions:
        """Pick and place that are likely together, then the lift, for images (B, 4 k, H, W).

        Args:
            avoid: (B, H, W) bool, network pixels that are not to be picked; not all of a picture

        Raises:
            InputError: an image of another shape.
        """
        self._check(image)
        n = self.config.n_rotations_eval
        choices = []
        for k in range(len(image)):
            heat, place = self._heat(image[k : k + 1], n_rotations=n)
            if avoid is not None:
                heat = heat.masked_fill(avoid[k].to(heat.device), -math.inf)
            choices.append(choose(heat.cpu(), place, picks=self.config.picks))
        pick, place = (
            torch.stack([getattr(each, name) for each in choices]) for name in ("pick", "place")
        )
        yaw = -np.array([float(each.rotation) for each in choices]) * (2 * math.pi / n)
        choice = np.zeros(len(image), int)
        if self.lift is not None:
            choice = self.lift(image, pick).argmax(dim=1).cpu().numpy()
        return PixelActions(
            self.config.to_camera(pick.numpy()),
            self.config.to_camera(place.numpy()),
            np.where(yaw < -math.pi, yaw + 2 * math.pi, yaw),
            np.array(self.config.lifts)[choice],
        )

    def _heat(
        self, image: Tensor, *, n_rotations: int
    ) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
        """Pick logits (H, W) of one image, and what says place logits (R, H, W) of a pick (2,)."""
        if self.pick_place is not None:
            heat, place = self.pick_place.each(image, n_rotations=n_rotations)
        else:
            heat = self.attention(image)
            place = partial(self.transport.forward, image, n_rotations=n_rotations)
        return heat[0], lambda pick: place(pick[None])[0].cpu()

    def _check(self, image: Tensor) -> None:
        shape = (CHANNELS * self.pictures * self.config.images, *self.config.shape)
        if image.ndim != 4 or image.shape[1:] != shape:
            raise InputError(f"image: shape {('B', *shape)} is needed, got {tuple(image.shape)}")


class GoalSplit(Transporter):
    """Transporter-Goal-Split: a third network sees the goal and multiplies key and query features.

    Attention sees current and goal pictures stacked; features are never cropped before the query.
    """

    name = "goal-split"
    pictures = 2
    goal_split = True


class GoalStack(Transporter):
    """Transporter-Goal-Stack: every network sees current and goal pictures stacked."""

    name = "goal-stack"
    pictures = 2
    crop_before_query = True
