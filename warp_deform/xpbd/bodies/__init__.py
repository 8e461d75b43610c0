"""Rigid bodies made of boxes: motion, and contact with everything, with their adjoints."""
