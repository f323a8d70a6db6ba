"""Fills the holes of free-viewpoint video, live."""
