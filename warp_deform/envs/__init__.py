"""The Gymnasium environments over a task, alone and side by side, and their wrappers."""
