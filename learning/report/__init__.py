"""Tables and curves from the folders of many runs."""
