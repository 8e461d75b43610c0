"""A Newton model read into the arrays that the kernels work on, world by world in lanes."""
