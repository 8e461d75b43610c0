"""Contact and friction between particles, triangles, edges and the table, with their adjoints."""
