"""The networks' parts against plain formulas, and the optimiser against its own."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from learning.models.adam import KerasAdam
from learning.models.attention import Attention
from learning.models.correlation import correlate_direct, correlate_fft
from learning.models.crops import crop_reach, rotated_crops
from learning.models.images import image_tensor, normalise
from learning.models.lift import LiftHead
from learning.models.resnet import NetworkConfig, ResNet43, receptive_span
from learning.models.transport import Transport
from warp_deform.errors import InputError


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def count(module: torch.nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def test_parameter_counts_are_the_original_s() -> None:
    g = generator()
    attention = Attention(generator=g)
    assert count(attention) == 9_833_203
    assert len(attention.network.convolutions()) == 57
    assert count(Attention(pictures=2, generator=g)) == 9_836_659
    assert count(Transport(generator=g)) == 19_666_866
    assert count(Transport(pictures=2, generator=g)) == 19_673_778
    assert count(Transport(pictures=2, goal_split=True, generator=g)) == 29_500_299


def test_weights_start_glorot_uniform_and_leave_the_global_generator_alone() -> None:
    before = torch.get_rng_state()
    first, again, other = (ResNet43(1, generator=generator(s)) for s in (0, 0, 1))
    assert torch.equal(before, torch.get_rng_state())
    for ours, same, different in zip(
        first.convolutions(), again.convolutions(), other.convolutions(), strict=True
    ):
        assert torch.equal(ours.weight, same.weight)
        assert not torch.equal(ours.weight, different.weight)
        assert not ours.bias.any()
        # What a file of weights needs; the memory format of maps is the forward pass's affair.
        assert ours.weight.is_contiguous()
        out, into, height, width = ours.weight.shape
        limit = math.sqrt(6 / (height * width * (into + out)))
        assert ours.weight.abs().max() <= limit
        if ours.weight.numel() > 1000:
            assert float(ours.weight.detach().std()) == pytest.approx(limit / 3**0.5, rel=0.1)


def test_single_precision_gradients_agree_with_double() -> None:
    """A width whose few channels made a strided convolution corrupt memory."""
    x = torch.randn(2, 6, 96, 56, generator=generator(1))
    config = NetworkConfig(width=0.125)
    single, double = (ResNet43(1, config=config, generator=generator()) for _ in range(2))
    single(x).square().mean().backward()
    double.double()(x.double()).square().mean().backward()
    for ours, exact in zip(single.parameters(), double.parameters(), strict=True):
        assert ours.grad is not None and exact.grad is not None
        assert (ours.grad - exact.grad).abs().max() <= 1e-4 * exact.grad.abs().max()


@pytest.mark.parametrize("equivariant", [False, True])
@pytest.mark.parametrize("skips", [False, True])
def test_receptive_span_is_what_gradients_reach(skips: bool, equivariant: bool) -> None:
    config = NetworkConfig(width=0.01, skips=skips, equivariant=equivariant)
    network = ResNet43(1, config=config, generator=generator())
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.abs_()  # no ReLU stops a gradient
    x = torch.ones(1, 6, 256, 8, requires_grad=True)
    y = network(x)
    for row in range(120, 128):
        (gradient,) = torch.autograd.grad(y[0, 0, row].sum(), x, retain_graph=True)
        reached = torch.nonzero(gradient[0, 0].sum(dim=1)).flatten()
        span = receptive_span(row, row + 1, equivariant=equivariant)
        assert (int(reached[0]), int(reached[-1]) + 1) == span


@pytest.mark.parametrize("equivariant", [False, True])
def test_skips_leave_the_rest_as_it_was(equivariant: bool) -> None:
    """Laterals are drawn last, so networks with and without begin with the same weights."""
    plain, skipping = (
        ResNet43(
            1,
            config=NetworkConfig(width=0.25, skips=each, equivariant=equivariant),
            generator=generator(),
        )
        for each in (False, True)
    )
    for before, after in zip(plain.convolutions(), skipping.convolutions(), strict=False):
        assert torch.equal(before.weight, after.weight)
    x = torch.rand(1, 6, 16, 24, generator=generator())
    assert not torch.equal(plain(x), skipping(x))
    with torch.no_grad():
        for lateral in skipping.laterals:
            lateral.weight.zero_()
    assert torch.equal(plain(x), skipping(x))


def test_image_sides_must_be_multiples_of_eight() -> None:
    with pytest.raises(InputError, match="12 x 16"):
        ResNet43(1, config=NetworkConfig(width=0.1), generator=generator())(
            torch.zeros(1, 6, 12, 16)
        )
    with pytest.raises(InputError, match="width"):
        NetworkConfig(width=0.0)


@pytest.mark.parametrize("equivariant", [False, True])
def test_bfloat16_is_near_float32(equivariant: bool) -> None:
    x = torch.randn(1, 6, 64, 32, generator=generator())
    exact, rounded = (
        ResNet43(
            1,
            config=NetworkConfig(width=0.25, skips=True, equivariant=equivariant, bfloat16=b),
            generator=generator(1),
        )(x)
        for b in (False, True)
    )
    assert rounded.dtype == torch.float32
    assert 0 < (exact - rounded).abs().max() < 0.05 * exact.abs().max()


def test_normalised_border_and_channels() -> None:
    raw = torch.zeros(1, 8, 2, 2)
    raw[0, :3, 0, 0] = 0.18877631 * 255
    raw[0, 7, 1, 1] = 0.00509261 + 0.00903967
    x = normalise(raw)[0]
    assert x.shape == (12, 2, 2)
    assert x[:3, 0, 0].abs().max() < 1e-5
    assert x[0, 1, 1] == pytest.approx(-2.5943422)
    assert x[5, 1, 1] == pytest.approx(-0.56336248)
    assert x[9:, 1, 1].tolist() == pytest.approx([1.0] * 3)
    with pytest.raises(InputError, match="multiple of 4"):
        normalise(torch.zeros(1, 6, 2, 2))


def test_coarse_image_is_the_mean_of_its_pixels() -> None:
    rng = np.random.default_rng(0)
    color = rng.integers(0, 256, (4, 6, 3), dtype=np.uint8)
    height = rng.uniform(size=(4, 6)).astype(np.float32)
    image = image_tensor(color, height, scale=2)
    assert image.shape == (4, 2, 3)
    assert image[1, 1, 2] == pytest.approx(color[2:4, 4:6, 1].mean())
    assert image[3, 0, 1] == pytest.approx(height[0:2, 2:4].mean())
    with pytest.raises(InputError, match="divide 4 and 6"):
        image_tensor(color, height, scale=4)


def test_fine_image_holds_every_pixel() -> None:
    rng = np.random.default_rng(0)
    color = rng.integers(0, 256, (4, 6, 3), dtype=np.uint8)
    height = rng.uniform(size=(4, 6)).astype(np.float32)
    image = image_tensor(color, height, scale=2, fine=True)
    assert image.shape == (16, 2, 3)
    whole = image_tensor(color, height)
    for k, (row, column) in enumerate([(0, 0), (0, 1), (1, 0), (1, 1)]):
        assert torch.equal(image[4 * k : 4 * k + 4], whole[:, row::2, column::2])
    mean = image.reshape(4, 4, 2, 3).mean(dim=0)
    assert torch.allclose(mean, image_tensor(color, height, scale=2), rtol=1e-5)


@settings(derandomize=True, deadline=None, max_examples=20)
@given(
    half=st.integers(1, 4),
    more=st.tuples(st.integers(1, 9), st.integers(1, 9)),
    n=st.integers(1, 3),
)
def test_correlations_agree_with_the_definition(half: int, more: tuple[int, int], n: int) -> None:
    size, g = 2 * half, generator(half)
    key = torch.randn(2, 3, size + more[0], size + more[1], generator=g)
    kernels = torch.randn(2, n, 3, size, size, generator=g)
    expected = torch.empty(2, n, *more)
    for u, v in np.ndindex(more):
        patch = key[:, None, :, u : u + size, v : v + size]
        expected[:, :, u, v] = (patch * kernels).sum(dim=(2, 3, 4)) / size**2
    for correlate in (correlate_direct, correlate_fft):
        torch.testing.assert_close(correlate(key, kernels), expected, rtol=1e-5, atol=1e-5)


def turned(map_: np.ndarray, pivot: tuple[int, int], theta: float) -> np.ndarray:
    """The whole map turned about a pivot, pixel by pixel, in float32 as the original's library."""
    c, s = math.cos(theta), math.sin(theta)
    row, column = pivot
    tx = np.float32(column - c * column + s * row)
    ty = np.float32(row - s * column - c * row)
    c, s = np.float32(c), np.float32(s)
    out = np.zeros_like(map_)
    for u, v in np.ndindex(map_.shape):
        x, y = (
            c * np.float32(v) - s * np.float32(u) + tx,
            s * np.float32(v) + c * np.float32(u) + ty,
        )
        i, j = (int(math.copysign(math.floor(abs(float(z)) + 0.5), z)) for z in (y, x))
        if 0 <= i < map_.shape[0] and 0 <= j < map_.shape[1]:
            out[u, v] = map_[i, j]
    return out


@pytest.mark.parametrize("n_rotations", [1, 6, 24])
@pytest.mark.parametrize("pivot", [(8, 8), (13, 9), (23, 11)])
def test_rotated_crops_are_crops_of_turned_maps(n_rotations: int, pivot: tuple[int, int]) -> None:
    map_ = np.random.default_rng(0).uniform(1, 2, (32, 20)).astype(np.float32)
    crops = rotated_crops(
        torch.from_numpy(map_)[None, None],
        torch.tensor([pivot]),
        size=16,
        n_rotations=n_rotations,
    )
    assert crops.shape == (1, n_rotations, 1, 16, 16)
    u, v = pivot[0] - 8, pivot[1] - 8
    for i in range(n_rotations):
        whole = turned(map_, pivot, 2 * math.pi * i / n_rotations)
        assert np.array_equal(crops[0, i, 0], whole[u : u + 16, v : v + 16])


def test_crop_reach_bounds_what_is_sampled() -> None:
    x = torch.zeros(1, 1, 101, 101, requires_grad=True)
    rotated_crops(x, torch.tensor([[50, 50]]), size=32, n_rotations=24).sum().backward()
    assert x.grad is not None
    seen = torch.nonzero(x.grad[0, 0]) - 50
    assert crop_reach(32, 24) - 1 <= seen.abs().max() <= crop_reach(32, 24)


def test_exact_attention_pads_to_a_square() -> None:
    image = torch.rand(1, 4, 80, 40, generator=generator()) * 50
    config = NetworkConfig(width=0.125)
    plain, exact = (
        Attention(config=config, exact=e, generator=generator(1)) for e in (False, True)
    )
    padded = torch.nn.functional.pad(image, (20, 20))
    assert torch.equal(exact(image), plain(padded)[:, :, 20:60])
    assert not torch.allclose(exact(image), plain(image))


def test_lift_is_read_from_the_current_picture_at_the_pick() -> None:
    head = LiftHead(3, crop=16, generator=generator())
    image, pick = torch.rand(1, 8, 40, 40, generator=generator(1)) * 50, torch.tensor([[20, 20]])
    before = head(image, pick)
    image[:, 4:] = 0
    image[:, :, :12], image[:, :, 28:] = 0, 0
    assert before.shape == (1, 3)
    assert torch.equal(head(image, pick), before)
    image[:, 0, 20, 20] += 100
    assert not torch.equal(head(image, pick), before)
    for n_lifts, crop in ((1, 16), (2, 24), (2, 4), (2, 128)):
        with pytest.raises(InputError):
            LiftHead(n_lifts, crop=crop, generator=generator())


def test_keras_adam_follows_its_formula_and_resumes() -> None:
    gradients = np.array([3e-6, -2e-7, 5e-5, 1e-6])
    parameter = torch.nn.Parameter(torch.tensor([0.5], dtype=torch.float64))
    optimiser = KerasAdam([parameter], lr=1e-2)
    x, m, v = 0.5, 0.0, 0.0
    for t, gradient in enumerate(gradients, start=1):
        if t == 3:
            state = optimiser.state_dict()
            optimiser = KerasAdam([parameter], lr=1.0)
            optimiser.load_state_dict(state)
        parameter.grad = torch.tensor([gradient], dtype=torch.float64)
        optimiser.step()
        m, v = 0.9 * m + 0.1 * gradient, 0.999 * v + 0.001 * gradient**2
        rate = 1e-2 * math.sqrt(1 - 0.999**t) / (1 - 0.9**t)
        x -= rate * m / (math.sqrt(v) + 1e-7)
        assert float(parameter.detach()) == pytest.approx(x, rel=1e-12)
