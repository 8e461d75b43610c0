"""The fused XPBD engine: a launch runs many substeps, a thread runs L worlds in SIMD lanes."""
