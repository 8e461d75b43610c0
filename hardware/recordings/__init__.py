"""Episodes on the disk: written while they run, read, replayed, scored and packed."""
