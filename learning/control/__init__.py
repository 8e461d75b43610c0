"""Policies for control at 20 Hz: by analytic gradients (APG, SHAC), and by PPO beside them."""
