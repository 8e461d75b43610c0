"""The folder of a training run: settings, log, snapshots."""
