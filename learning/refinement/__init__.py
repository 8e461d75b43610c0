"""Better demonstrations from recorded ones, by search and by gradient."""
