"""Who chooses actions at the table, by the names of `--agent`; each is a `Chooser`.

`planner` searches in simulation, `policy` was trained, `scripted` reads the simulated chain,
`random` draws, and with `human` and `typed` a person shows where to pick and place.
"""
