"""Cameras behind the `Camera` protocol; each module loads its vendor's package on opening."""

__all__: list[str] = []
