"""Cameras, rigid motion, visual hull, surface, rasterisation, reprojection: pure functions on tensors."""
