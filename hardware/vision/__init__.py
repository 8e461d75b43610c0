"""What a picture says: the workspace from above, the cable's mask, the chain under the mask."""
