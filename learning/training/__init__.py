"""One loop, read from top to bottom, and what it takes: schedules, state, processes."""
