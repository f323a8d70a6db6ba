"""Captures on disk, the readers, held-out scenes, and the synthetic studio."""
