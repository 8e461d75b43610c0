"""Measuring a setup step by step, with a person at the robot."""
