"""The kernels compile for CUDA from the same source; running them needs a device."""

from pathlib import Path

import pytest
import warp as wp

from warp_deform.xpbd.kernels.adjoint import adjoint_kernel
from warp_deform.xpbd.kernels.forward import forward_kernel


def compiled(kernel: wp.Kernel, folder: Path, name: str) -> str:
    """PTX of a kernel's module, not optimised: that takes four times as long, and tells no more."""
    options = dict(kernel.module.options)
    kernel.module.options["mode"] = "debug"
    try:
        (ptx,) = wp.compile_aot_module(
            kernel.module, arch=80, module_dir=str(folder / name), use_ptx=True
        )
    finally:
        kernel.module.options = options
    return Path(ptx).read_text()


@pytest.mark.parametrize(("with_bodies", "with_sheets"), [(False, False), (True, True)])
def test_the_solver_compiles_to_ptx(tmp_path: Path, with_bodies: bool, with_sheets: bool) -> None:
    kernel = forward_kernel(wp.float32, 1, with_bodies, with_sheets, with_sheets)
    assert ".visible .entry forward" in compiled(kernel, tmp_path, "forward")


def test_its_adjoint_compiles_to_ptx(tmp_path: Path) -> None:
    variant = (wp.float32, 1, False, True, True)
    for kernel, name in (
        (forward_kernel(*variant, taped=True), "forward"),
        (adjoint_kernel(*variant), "adjoint"),
    ):
        assert f".visible .entry {name}" in compiled(kernel, tmp_path, name)
