"""Where to place: the transport's options against their definitions."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from learning.models.correlation import correlate_direct
from learning.models.crops import rotated_crops
from learning.models.images import normalise
from learning.models.resnet import NetworkConfig
from learning.models.transport import Transport
from warp_deform.errors import InputError


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def assert_sums_close(actual: Tensor, expected: Tensor) -> None:
    """Sums of many products that nearly cancel are as exact as their greatest."""
    bound = 1e-6 * float(expected.abs().max())
    torch.testing.assert_close(actual, expected, atol=bound, rtol=1e-4)


@pytest.mark.parametrize("equivariant", [False, True])
@pytest.mark.parametrize("n_rotations", [1, 5])
@pytest.mark.parametrize(
    "picks", [[[0, 0], [150, 3]], [[159, 79], [150, 60]], [[80, 40], [81, 40]]]
)
def test_window_of_the_query_changes_nothing(
    picks: list[list[int]], n_rotations: int, equivariant: bool
) -> None:
    g = generator(3)
    config = NetworkConfig(width=0.125, skips=n_rotations == 5, equivariant=equivariant)
    transport = Transport(crop=16, config=config, exact=True, generator=g)
    image = (
        torch.rand(2, 4, 320, 80, generator=g) * torch.tensor([255, 255, 255, 0.1])[:, None, None]
    )
    pick = torch.tensor(picks)
    with torch.no_grad():
        ours = transport(image, pick, n_rotations=n_rotations)
        x = normalise(torch.nn.functional.pad(image, (8, 8, 8, 8)))
        kernels = rotated_crops(transport.query(x), pick + 8, size=16, n_rotations=n_rotations)
        if equivariant:  # a crop's first row and column have no partner across the pick
            kernels[..., 0, :] = kernels[..., 0] = 0
        whole = correlate_direct(transport.key(x), kernels)
    assert ours.shape == (2, n_rotations, 320, 80)
    assert (ours - whole).abs().max() < 1e-5 * whole.abs().max()


@pytest.mark.parametrize("pad_features", [False, True])
def test_a_mark_tells_key_and_goal_how_far_the_pick_is(pad_features: bool) -> None:
    """By its definition, and nothing where its weights are zero."""
    image, config = 50 * torch.rand(1, 8, 40, 32, generator=generator(1)), NetworkConfig(width=0.01)
    plain, marked = (
        Transport(
            pictures=2,
            goal_split=True,
            crop=16,
            config=config,
            mark_pick=each,
            pad_features=pad_features,
            generator=generator(),
        )
        for each in (False, True)
    )
    missing = marked.load_state_dict(plain.state_dict(), strict=False).missing_keys
    assert {key.split(".")[0] for key in missing} == {"key", "goal"}
    pick, frame = torch.tensor([[9, 21]]), 0 if pad_features else 8
    seen: dict[torch.nn.Module, Tensor] = {}
    for network in (marked.key, marked.goal):
        network.mark.register_forward_pre_hook(
            lambda module, given: seen.update({module: given[0]})
        )
    with torch.no_grad():
        assert not torch.allclose(marked(image, pick), plain(image, pick))
        for network in (marked.key, marked.goal):
            mark = seen[network.mark]
            assert mark.shape == (1, 3, 40 + 2 * frame, 32 + 2 * frame)
            for channel, reach in enumerate((2, 8, 32)):
                for row, column in ((9, 21), (12, 25), (0, 0)):
                    far = math.hypot(row - 9, column - 21)
                    value = float(mark[0, channel, row + frame, column + frame])
                    assert value == pytest.approx(math.exp(-far / reach), rel=1e-5)
            network.mark.weight.zero_()
        assert torch.equal(marked(image, pick), plain(image, pick))


@pytest.mark.parametrize("pad_features", [False, True])
@pytest.mark.parametrize("goal_split", [False, True])
def test_pictures_of_a_batch_do_not_meet(goal_split: bool, pad_features: bool) -> None:
    network = Transport(
        pictures=2,
        goal_split=goal_split,
        crop=16,
        config=NetworkConfig(width=0.01),
        mark_pick=True,
        pad_features=pad_features,
        generator=generator(),
    )
    image = 50 * torch.rand(2, 8, 40, 32, generator=generator(1))
    picks = torch.tensor([[3, 2], [35, 28]])
    with torch.no_grad():
        pairs = zip(image, picks, strict=True)
        alone = torch.cat([network(scene[None], pick[None]) for scene, pick in pairs])
        together = network(image, picks)
    assert (together - alone).abs().max() < 1e-5 * alone.abs().max()


@pytest.mark.parametrize("n_rotations", [1, 4])
@pytest.mark.parametrize("pick", [[0, 0], [39, 5], [20, 16]])
def test_features_may_be_framed_in_place_of_the_picture(pick: list[int], n_rotations: int) -> None:
    """By the definition: features of the bare picture, zeros around, then crops and correlation."""
    image = 50 * torch.rand(1, 8, 40, 32, generator=generator(1))
    framed, config = (8, 8, 8, 8), NetworkConfig(width=0.01)
    where = torch.tensor([pick])
    x, goal = normalise(image).chunk(2, dim=1)
    single = Transport(crop=16, config=config, pad_features=True, generator=generator())
    split = Transport(
        pictures=2,
        goal_split=True,
        crop=16,
        config=config,
        pad_features=True,
        goal_bias=1.0,
        generator=generator(),
    )
    with torch.no_grad():
        factor = split.goal(goal) + 1
        for module, seen, by in ((single, image[:, :4], torch.ones(())), (split, image, factor)):
            key, query = (
                functional.pad(network(x) * by, framed) for network in (module.key, module.query)
            )
            crops = rotated_crops(query, where + 8, size=16, n_rotations=n_rotations)
            scores = module(seen, where, n_rotations=n_rotations)
            assert_sums_close(scores, correlate_direct(key, crops))
        single.crop_before_query = True  # crops reach beyond the picture still
        edge = normalise(functional.pad(image[:, :4], framed))
        crops = rotated_crops(edge, where + 8, size=16, n_rotations=n_rotations)
        kernels = single.query(crops[0])[None]
        key = functional.pad(single.key(x), framed)
        scores = single(image[:, :4], where, n_rotations=n_rotations)
        assert_sums_close(scores, correlate_direct(key, kernels))


def test_focus_adds_a_mean_close_to_the_pick() -> None:
    """By the definition: products at equal distances from pick and place, in a bell around them."""
    image = 50 * torch.rand(1, 4, 40, 32, generator=generator(1))
    pick, place, crop = torch.tensor([[21, 9]]), (30, 14), 16
    plain, focused = (
        Transport(
            crop=crop,
            config=NetworkConfig(width=0.01),
            gain=3.0,
            focus=focus,
            generator=generator(),
        )
        for focus in (0.0, 0.2)
    )
    with torch.no_grad():
        difference = focused(image, pick)[0, 0] - plain(image, pick)[0, 0]
        x = normalise(functional.pad(image, (8, 8, 8, 8)))
        key, query = plain.key(x)[0].double(), plain.query(x)[0].double()
    expected = total = 0.0
    for row, column in itertools.product(range(-8, 8), repeat=2):
        weight = math.exp(-(row**2 + column**2) / (2 * 1.5**2))
        at_place = key[:, place[0] + 8 + row, place[1] + 8 + column]
        at_pick = query[:, pick[0, 0] + 8 + row, pick[0, 1] + 8 + column]
        expected += weight * float(at_place @ at_pick)
        total += weight
    assert float(difference[place]) == pytest.approx(3.0 * 0.2 * expected / total, rel=1e-3)


def test_options_that_exclude_each_other_are_refused() -> None:
    with pytest.raises(InputError, match="pictures"):
        Transport(goal_split=True, generator=generator())
    with pytest.raises(InputError, match="crop_before_query"):
        Transport(pictures=2, goal_split=True, crop_before_query=True, generator=generator())
    config = NetworkConfig(width=0.01, subpixels=2)
    fine = Transport(crop=16, config=config, crop_before_query=True, generator=generator())
    image, pick = torch.zeros(1, 16, 24, 24), torch.tensor([[12, 12]])
    assert fine(image, pick).shape == (1, 1, 24, 24)
    with pytest.raises(InputError, match="fine"):
        fine(image, pick, n_rotations=4)
