"""Policies for control at 20 Hz, trained by analytic gradients (APG)."""
