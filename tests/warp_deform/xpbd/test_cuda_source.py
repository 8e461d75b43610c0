"""The kernels compile for CUDA from the same source; running them needs a device."""

from pathlib import Path

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


def test_everything_that_is_recorded_compiles_to_ptx(tmp_path: Path) -> None:
    """Cables, sheets and bodies with a tape: each adds to the code and leaves nothing of it out."""
    kernel = forward_kernel(wp.float32, 1, True, True, True, taped=True)
    assert ".visible .entry forward" in compiled(kernel, tmp_path, "forward")


def test_its_adjoint_compiles_to_ptx(tmp_path: Path) -> None:
    kernel = adjoint_kernel(wp.float32, 1, False, True, True)
    assert ".visible .entry adjoint" in compiled(kernel, tmp_path, "adjoint")
