"""How good a snapshot is: protocols, episodes, kinds of failure, intervals, videos."""
