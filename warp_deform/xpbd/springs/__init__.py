"""Constraints within an object: links, bending, tethers, viscosity, sleep, with their adjoints."""
