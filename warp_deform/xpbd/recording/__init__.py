"""Launches recorded: for derivatives, and to reproduce the one in which a guard fired."""
