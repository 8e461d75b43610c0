"""The kernels compile for CUDA from the same source; running them needs a device."""

from pathlib import Path

import pytest
import warp as wp

from warp_deform.solver.adjoint import adjoint_kernel
from warp_deform.solver.forward import forward_kernel


@pytest.mark.parametrize(("with_bodies", "with_sheets"), [(False, False), (True, True)])
def test_the_solver_compiles_to_ptx(tmp_path: Path, with_bodies: bool, with_sheets: bool) -> None:
    kernel = forward_kernel(wp.float32, 1, with_bodies, with_sheets, with_sheets)
    (ptx,) = wp.compile_aot_module(kernel.module, arch=80, module_dir=str(tmp_path), use_ptx=True)
    assert ".visible .entry forward" in Path(ptx).read_text()


def test_its_adjoint_compiles_to_ptx(tmp_path: Path) -> None:
    variant = (wp.float32, 1, False, True, True)
    for kernel, name in (
        (forward_kernel(*variant, taped=True), "forward"),
        (adjoint_kernel(*variant), "adjoint"),
    ):
        folder = tmp_path / name
        (ptx,) = wp.compile_aot_module(kernel.module, arch=80, module_dir=str(folder), use_ptx=True)
        assert f".visible .entry {name}" in Path(ptx).read_text()
