"""Captures on disk: their formats, the checks before use, colour matching, images and videos."""
