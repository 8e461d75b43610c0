"""What acts: a snapshot's agent, and what it remembers within an episode."""
