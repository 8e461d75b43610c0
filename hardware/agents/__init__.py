"""Who chooses the actions: policies, the planner, the true state, chance, or a person."""
