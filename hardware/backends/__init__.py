"""The robots behind the `Robot` protocol; each module loads its vendor's package on connecting."""

__all__: list[str] = []
