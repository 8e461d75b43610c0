"""Demonstrations as a network learns from them: a memory-mapped cache, batches, augmentation."""
