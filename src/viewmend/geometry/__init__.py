"""Cameras, rigid motion, visual hull, surface, rasterisation, sampling: pure functions on tensors."""
