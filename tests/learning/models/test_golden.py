"""Parity with the original's TensorFlow modules: forward, loss, and one training step.

tests/data/README.md says what the file holds. Errors are relative to the largest logit. Two modules
hold every layer and make a step here; `python benchmarks/parity.py` steps them all.
"""

from __future__ import annotations

import importlib.util
import sys
from types import ModuleType

import numpy as np
import pytest
from fixtures.places import ROOT


def _parity() -> ModuleType:
    """The module `benchmarks/parity.py`."""
    path = ROOT / "benchmarks" / "parity.py"
    spec = importlib.util.spec_from_file_location("parity", path)
    assert spec is not None and spec.loader is not None
    module = sys.modules["parity"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


parity = _parity()
STEPPED = ("attention", "transport_crop_after")


@pytest.fixture(scope="module")
def golden() -> dict[str, np.ndarray]:
    return parity.read_golden()


@pytest.mark.parametrize("name", parity.MODULES)
def test_parity(name: str, golden: dict[str, np.ndarray]) -> None:
    errors = parity.measure(name, golden, step=name in STEPPED)
    assert errors.logits < 1e-5 and errors.loss < 1e-5
    assert (errors.after_step is not None) == (name in STEPPED)
    assert errors.after_step is None or errors.after_step < 5e-4
