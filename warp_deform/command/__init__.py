"""The `warp-deform` command: a table of verbs, their options, and what they answer."""
