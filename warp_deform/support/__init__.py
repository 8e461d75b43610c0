"""What every room uses: numbers checked, extras named, progress told, the revision of the code."""
