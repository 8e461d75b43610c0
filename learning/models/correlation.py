"""Cross-correlation of feature maps with kernels cut out of them, divided by the kernel's area.

Source: Zeng et al., CoRL 2020. The original convolves directly with the kernel padded by one zero
row and column, so that 384 x 224 gives 320 x 160; `correlate_fft` computes the same numbers (to
rounding) at a cost that does not grow with the kernel. On a CPU it is tens to hundreds of times
faster.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

__all__ = ["correlate_direct", "correlate_fft"]


def correlate_direct(features: Tensor, kernels: Tensor) -> Tensor:
    """Mean products (B, R, H - S, W - S) of maps (B, C, H, W) and kernels (B, R, C, S, S)."""
    size = kernels.shape[-1]
    padded = functional.pad(kernels, (0, 1, 0, 1))
    # One convolution a sample: grouped convolutions are several times slower on a CPU.
    maps = [functional.conv2d(x[None], kernel) for x, kernel in zip(features, padded, strict=True)]
    return torch.cat(maps) / size**2


def correlate_fft(features: Tensor, kernels: Tensor) -> Tensor:
    """Mean products (B, R, H - S, W - S) as `correlate_direct`, through the convolution theorem."""
    size = kernels.shape[-1]
    rows, columns = features.shape[-2:]
    # Periodic images do not reach the part that is kept, whatever the padding to smooth sizes.
    period = (_smooth(rows), _smooth(columns))
    spectrum = torch.fft.rfft2(features, s=period)[:, None]
    spectra = torch.fft.rfft2(kernels, s=period)
    # A sum of products: einsum would turn it into many tiny matrix products.
    product = (spectrum * spectra.conj()).sum(dim=2)
    full = torch.fft.irfft2(product, s=period)
    return full[..., : rows - size, : columns - size] / size**2


def _smooth(size: int) -> int:
    """Least number from `size` whose prime factors are 2, 3 and 5; FFTs of such are fast."""
    while True:
        rest = size
        for prime in (2, 3, 5):
            while rest % prime == 0:
                rest //= prime
        if rest == 1:
            return size
        size += 1
