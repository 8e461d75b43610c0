"""The benchmark's tasks, one file each.

`registry` names them, `task` holds what a task is. Importing them loads neither Newton nor torch.
"""
