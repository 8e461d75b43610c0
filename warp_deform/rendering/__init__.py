"""Pictures: top-down colour, height and segmentation, RGB-D cameras, frames for people."""
