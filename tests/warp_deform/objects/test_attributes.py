"""What our attributes ask of Newton when a builder gets them."""

import sys

import warp as wp
from fixtures.solver_scenes import new_builder

from warp_deform.objects import attributes


def test_kernels_that_finalize_a_model_compile_soon() -> None:
    modules = [sys.modules[name] for name in attributes._FORWARD_ONLY]
    for module in modules:
        wp.set_module_options({"enable_backward": True, "optimization_level": 3}, module)
    attributes._leave_adjoints_out.cache_clear()
    new_builder()
    for module in modules:
        options = wp.get_module_options(module)
        assert options["enable_backward"] is False and options["optimization_level"] == 0
