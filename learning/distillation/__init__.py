"""From nothing to a policy within a budget: demonstrations, training, corrections, choice, test."""
