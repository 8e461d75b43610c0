"""What every room uses: files written whole, calls that end in time, things that are closed."""
