"""Episodes by the thousand: collected, replayed, filmed and looked into, over processes."""
