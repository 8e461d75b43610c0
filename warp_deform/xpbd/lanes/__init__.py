"""The scalar of L worlds, the structs of arrays of it, and the tape."""
