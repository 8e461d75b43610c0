"""In which precision convolutions are computed where nobody says so."""

from __future__ import annotations

import torch

__all__ = ["has_bfloat16_tiles"]


def has_bfloat16_tiles() -> bool:
    """Whether this processor multiplies whole tiles of bfloat16 (AMX).

    With AVX-512 BF16 alone a step takes a fifth longer than in float32 (`benchmarks/steps.py
    --bfloat16`). Elsewhere torch converts to float32 and back, which takes several times longer.
    """
    return bool(torch.cpu.get_capabilities().get("amx_bf16"))
