"""A robot, a camera and their calibration, opened together."""
