"""The benchmark's tasks, one file each, and what they share.

A file named like a task holds it: `cable_ring` holds cable-ring. `registry` lists all tasks, `task`
says what a task is. The other files are what several tasks use: the physics of their objects
(`*_physics`), scores (`metrics`), losses, shapes, grasps, free space. Importing them loads neither
Newton nor torch.
"""
