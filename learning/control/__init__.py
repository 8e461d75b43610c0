"""Policies for control at 20 Hz: trained by gradients (APG, SHAC, plan) or cloned, and tested."""
