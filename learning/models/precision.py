"""In which precision convolutions are computed where nobody says so."""

from __future__ import annotations

import torch

__all__ = ["has_bfloat16_units"]


def has_bfloat16_units() -> bool:
    """Whether this processor multiplies bfloat16 natively (AVX-512 BF16 or AMX).

    Elsewhere torch converts to float32 and back, which takes several times longer than float32.
    """
    found = torch.cpu.get_capabilities()
    return bool(found.get("avx512_bf16") or found.get("amx_bf16"))
