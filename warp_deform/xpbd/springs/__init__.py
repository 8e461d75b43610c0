"""Constraints within an object: links, bending, tethers, internal friction, with their adjoints."""
